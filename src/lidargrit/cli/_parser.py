"""The command line's parser: words as a user types them → options, or one line that names the wrong word."""

import argparse
import itertools
import re
from pathlib import Path
from typing import Any, NoReturn

from lidargrit.cli._catalogue import entries
from lidargrit.core.errors import UsageError, nearest_names, one_of
from lidargrit.core.untrusted import Number, check_path, check_word, whole_number

EXIT_CODES = """\
exit codes: 0 done, 1 a fault of lidargrit's own (with a traceback), 2 a mistake of the user (explained in one line),
            130 interrupted by Ctrl-C, 143 terminated (SIGTERM)
"""

_ALL_SHOWN = 9  # choices at most; of more, only those nearest to the user's word are shown
_OF_ONE_ARGUMENT = re.compile(r"argument (\S*): (.*)", re.DOTALL)
# argparse's messages → got, wanted, cure. The messages differ a little from one Python version to the next.
_EXPLANATIONS = (
    (re.compile(r"expected (?:one|at least one) argument"), "nothing after {name}", "a value", "write one behind it"),
    (re.compile(r"ignored explicit argument (.*)"), "{name} with {0}", "{name} alone", "leave the value out"),
)
SHELLS = ("bash", "zsh", "fish")
_KINDS = {"preset": "presets", "sensor": "sensors", "to": "sensors", "protocol": "protocols", "metrics": "metrics"}


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Adds its default to the help of every option that has one and does not describe it itself."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=25)  # where help of every verb takes the fewest lines

    def _format_args(self, action: argparse.Action, default_metavar: str) -> str:
        """Return what follows an option's name: WORD ... in place of argparse's WORD [WORD ...]."""
        if action.nargs in ("+", "*"):
            return f"{action.metavar or default_metavar} ..."
        return super()._format_args(action, default_metavar)

    def _format_action_invocation(self, action: argparse.Action) -> str:
        """Return the names of an option, with what follows them once."""
        if not action.option_strings or action.nargs == 0:
            return super()._format_action_invocation(action)
        return f"{', '.join(action.option_strings)} {self._format_args(action, action.dest.upper())}"

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        has_default = isinstance(action.default, (int, float, str, Path)) and not isinstance(action.default, bool)
        is_described = "default" in text or action.default in ("", argparse.SUPPRESS)
        shown = has_default and action.option_strings and not is_described
        return f"{text} (default: %(default)s)" if shown else text


class Parser(argparse.ArgumentParser):
    """argparse's parser, which raises our error in place of printing its usage and leaving."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        for kind, check in ((None, check_word), (Path, check_path), (int, whole_number), (float, Number())):
            self.register("type", kind, check)

    def error(self, message: str) -> NoReturn:
        """Raise argparse's complaint as got, wanted and cure."""
        raise UsageError(*self._explain(message))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # pyright: ignore
        """Parse, but refuse an unknown option first, whatever else may be missing."""
        for word in itertools.takewhile(lambda word: word != "--", args or ()):
            name, is_verb = word.partition("=")[0], self._subparsers is not None and not word.startswith("-")
            if is_verb:
                break  # what follows is for the verb's own parser
            if name.startswith("--") and not any(option.startswith(name) for option in self._option_string_actions):
                self.refuse(name)
        return super().parse_known_args(args, namespace)

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Convert the words behind one option, or of one argument; a blank one is not taken to be left out."""
        blank = [word for word in arg_strings if not word.strip()]
        if blank and action.type is None and action.choices is None:
            raise UsageError(f"{_name_of(action)} {blank[0]!r}", "a name or a value", "write one")
        return super()._get_values(action, arg_strings)

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        """Convert one word; the message of our own types is kept, with the option's name before it."""
        if isinstance(action, argparse._SubParsersAction):  # all words of a verb, whose own parser converts them
            return arg_string
        convert = self._registry_get("type", action.type, action.type)
        try:
            return convert(arg_string)
        except UsageError as error:
            raise UsageError(f"{_name_of(action)} {error.got}", error.wanted, error.cure) from None

    def short_usage(self) -> str:
        """Return the words that a command needs, in one line; its options are listed below it."""
        forms = {"?": "[{}]", "*": "[{} ...]", "+": "{} ..."}
        words = [action for action in self._actions if not action.option_strings]
        shown = [forms.get(str(each.nargs), "{}").format(str(each.metavar or each.dest).upper()) for each in words]
        return " ".join([self.prog, *shown, "[OPTION ...]"])

    def verbs(self) -> "list[Parser]":
        """Return the parsers of the verbs below this one."""
        below = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]
        return [parser for action in below for parser in action.choices.values()]

    def refuse(self, word: str) -> NoReturn:
        """Refuse an option that this parser does not have, or a word too many."""
        long = [option for option in self._option_string_actions if option.startswith("--")]
        option = word.startswith("-")
        got, wanted = (
            ("the option", f"one such as {nearest_names(word, long)}")
            if option
            else ("the unexpected argument", "fewer arguments")
        )
        raise UsageError(f"{got} {word!r}", wanted, self._help())

    def _explain(self, message: str) -> tuple[str, str, str]:
        of_one_argument = _OF_ONE_ARGUMENT.fullmatch(message)
        if of_one_argument is None:
            if missing := re.fullmatch(r"the following arguments are required: (.*)", message):
                return f"no {missing[1].replace(', ', ' and no ')}", self._wanted(), self._help()
            if ambiguous := re.fullmatch(r"ambiguous option: (\S+) could match (.*)", message):
                return ambiguous[1], one_of(ambiguous[2].split(", ")), "write it out"
            return message, "words as its help shows them", self._help()
        name, complaint = of_one_argument[1].partition("/")[0], of_one_argument[2]
        if chosen := re.match(r"invalid choice: '?(.*?)'? \(", complaint):
            choices = [str(choice) for choice in self._choices(of_one_argument[1])]
            several = one_of(choices) if len(choices) <= _ALL_SHOWN else nearest_names(chosen[1], choices)
            wanted = several if len(choices) <= _ALL_SHOWN else f"one such as {several}"
            got = f"{name} {chosen[1]}" if name.startswith("-") else repr(chosen[1])
            return got, wanted, "choose one" if len(choices) <= _ALL_SHOWN else self._help()
        for pattern, *parts in _EXPLANATIONS:
            if matched := pattern.match(complaint):
                values = [group.strip("'") for group in matched.groups()]
                got, wanted, cure = (part.format(*values, name=name) for part in parts)
                return got, wanted, cure
        return message, "other words", self._help()

    def _choices(self, name: str) -> list[Any]:
        """Return the choices of the argument that argparse calls by this name; empty if it has none."""
        for action in self._actions:
            names = ("/".join(action.option_strings), action.metavar, action.dest)
            if action.choices is not None and name in names:
                return list(action.choices)
        return []

    def _wanted(self) -> str:
        needed = [action for action in self._actions if action.required]
        shown = [[*action.option_strings[:1], str(action.metavar or action.dest).upper()] for action in needed]
        return " ".join([self.prog, *(word for words in shown for word in words)])

    def _help(self) -> str:
        return f"see: {self.prog} --help"


def _name_of(action: argparse.Action) -> str:
    return action.option_strings[0] if action.option_strings else str(action.metavar or action.dest)


def _is_number(action: argparse.Action) -> bool:
    return action.type in (int, float) or isinstance(action.type, Number)


def script(parser: Parser, shell: str) -> str:
    """Return the script of one shell; its verbs' names of presets, sensors, protocols and metrics are completed too."""
    import shtab

    for verb in parser.verbs():
        for action in verb._actions:
            if action.dest in _KINDS:
                action.choices = [entry["name"] for entry in entries(_KINDS[action.dest])]
            elif action.choices is None and action.nargs != 0 and not _is_number(action):  # but a place
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]  shtab looks for it there
    return shtab.complete(parser, shell)
