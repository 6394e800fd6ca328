"""What a user types: words → one function of the library, its result, and an exit code."""

import argparse
import errno
import importlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from lidargrit.cli._parser import EXIT_CODES, SHELLS, HelpFormatter, Parser, script
from lidargrit.cli._signals import raising_on_signals
from lidargrit.core import discovery, reporting
from lidargrit.core.errors import LidarGritError, OutputError, Terminated, UsageError
from lidargrit.core.version import __version__

_EXAMPLES = """\
examples:
  lidargrit demo                                    everything once, in minutes; no data needed
  lidargrit demo --data /data/kitti_odometry        the same on your own scans
  lidargrit train lidargrit_small runs/mine --set data.train=/data/scans data.val=/data/held_out
  lidargrit sample runs/mine samples -n 100
  lidargrit evaluate samples /data/held_out
  lidargrit view /data/held_out runs/mine -o side_by_side.png

a verb's own examples: lidargrit VERB --help
"""
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # parameters of mallopt (malloc.h of glibc)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; 0 = done, 2 = the user's mistake, printed in one line, 130 = interrupted, 143 = terminated."""
    try:
        with raising_on_signals():
            if arguments is None:
                return _run(sys.argv[1:], is_program=True)
            return _run([*arguments])  # list() here is our own verb
    except Terminated:  # before the command was read
        return 143
    except KeyboardInterrupt:
        return 130


def _run(words: list[str], is_program: bool = False) -> int:
    _let_threads_sleep()
    if is_program:
        _keep_freed_memory()
        if isinstance(sys.stdout, io.TextIOWrapper):  # names that its encoding lacks, as that of some locales
            sys.stdout.reconfigure(errors="backslashreplace")
    verb = words[0] if words and words[0] in _modules_of_verbs() else ""
    parser = build_parser(verb)
    try:
        options = _parsed(parser, words)
    except UsageError as error:
        print(f"lidargrit {verb}".rstrip() + f": {error}", file=sys.stderr)
        return 2
    if options.verb is None:
        told = script(parser, options.print_completion) if options.print_completion else parser.format_help()
        options.run = lambda _: print(told)
    try:
        reporter = reporting.TerminalReporter()
        tells = is_program and options.verb and os.environ.get("RANK", "0") == "0"
        aloud = reporter.never_silent(f"lidargrit {options.verb}", options.waits) if tells else nullcontext()
        with _refusing_unusable_paths(), reporting.to(reporter), aloud:
            _refuse_to_replace_what_is_read(options)
            options.run(options)
            if sys.stdout is not None:  # closed by the caller
                sys.stdout.flush()  # here, where a closed pipe is caught, and not when Python ends
    except LidarGritError as error:
        if options.debug:
            raise
        print(f"lidargrit {options.verb}: {error}", file=sys.stderr)
        return 2
    except Terminated:
        print(f"\nlidargrit {options.verb}: terminated; {_what_follows(options)}", file=sys.stderr)
        return 143
    except KeyboardInterrupt:
        print(f"\nlidargrit {options.verb}: interrupted; {_what_follows(options)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output, such as head, has seen enough
        _write_nowhere()
    return 0


def _write_nowhere() -> None:
    """Let Python write the rest of its output nowhere when it ends, after standard output has failed."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _what_follows(options: argparse.Namespace) -> str:
    """Say what the same command does when it is run again after an interruption."""
    words = vars(options)
    there = [file for file in (words.get("out"), words.get("json")) if file and file.is_file()]  # a report may not be
    if there and words.get("overwrite") is False:
        return f"{there[0]} is there, and the same command with --overwrite begins anew"
    return "the same command goes on" if options.goes_on else "the same command begins anew"


def _let_threads_sleep() -> None:
    """Have torch's threads sleep while they wait for one another, unless the user has set how they wait.

    OpenMP lets them spin by default. Beside a busy process, each spinning thread takes the processor from the thread
    that it waits for, and sampling takes ten times as long. The variables are read once, when torch is loaded.
    """
    if "torch" not in sys.modules and not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
        os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="0")


def _keep_freed_memory() -> None:
    """Have glibc's malloc keep up to 2 GiB of what torch frees for the next step, unless the user has set malloc up.

    By default it returns each block above 32 MiB to the system, which clears its pages again for the next step: up to a
    third of the time of training on a CPU. Other C libraries are left as they are.
    """
    by_user = any(name.startswith("MALLOC_") for name in os.environ)
    if sys.platform != "linux" or by_user or "glibc.malloc." in os.environ.get("GLIBC_TUNABLES", ""):
        return
    import ctypes

    with suppress(AttributeError):  # musl has no such function
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)


def _modules_of_verbs() -> dict[str, str]:
    """Return verbs as a user types them, and the name of each one's module."""
    return {name.replace("_", "-"): name for name in discovery.names("cli")}


def build_parser(verb: str = "") -> Parser:
    """Return the parser of one verb, or of all verbs, which takes ten times as long; what they do is not imported."""
    raw: dict[str, Any] = {"formatter_class": HelpFormatter}
    parser = Parser(prog="lidargrit", usage="lidargrit VERB ...", description=_EXAMPLES, epilog=EXIT_CODES, **raw)
    parser.add_argument("--version", action="version", version=f"lidargrit {__version__}")
    parser.add_argument("--debug", action="store_true", help="show a full traceback of an error")
    how = "print a script by which this shell completes verbs, options and names, see docs/how-to/from-programs.md"
    parser.add_argument("--print-completion", choices=SHELLS, default="", help=how)
    verbs = parser.add_subparsers(title="verbs", metavar="", dest="verb", prog="lidargrit")
    for word, name in _modules_of_verbs().items():
        if verb not in ("", word):
            continue
        module = importlib.import_module(f"lidargrit.cli.{name}")
        sub = verbs.add_parser(
            word,
            help=discovery.summary("cli", name),
            description=f"examples:\n{module.EXAMPLES}",
            **raw,
        )
        sub.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        # A verb that keeps what it has done, and goes on there, says so itself, and so does one that waits for others.
        sub.set_defaults(goes_on=False, waits=False)
        module.add_arguments(sub)
        sub.set_defaults(run=module.run, words=sub)
        sub.usage = sub.short_usage()
    return parser


def _parsed(parser: Parser, words: list[str]) -> argparse.Namespace:
    options, too_many = parser.parse_known_args(words)
    if too_many:
        (options.words if options.verb else parser).refuse(too_many[0])
    if options.verb and options.print_completion:
        got = f"--print-completion {options.print_completion} before {options.verb}"
        raise UsageError(got, "one of them", f"leave {options.verb} out")
    return options


def _refuse_to_replace_what_is_read(options: argparse.Namespace) -> None:
    """Raise OutputError if a file that the command would write is one that it reads, ``--overwrite`` or not."""
    words = [*vars(options).values()]
    words += [word for value in words if isinstance(value, Sequence) and not isinstance(value, str) for word in value]
    read = [word for word in words if isinstance(word, str) and os.path.isfile(word)]  # a source is no Path: DATA:ROOT
    for path in words:
        if isinstance(path, Path) and path.is_file() and any(os.path.samefile(path, word) for word in read):
            raise OutputError(f"{path}, which is also read", "another name", "choose one")


@contextmanager
def _refusing_unusable_paths() -> Iterator[None]:
    """Turn the system's refusal of a path into an error of one line, wherever the path was opened."""
    try:
        yield
    except OSError as error:
        if error.filename:
            raise UsageError(f"{error.strerror} for {error.filename}", "a file that can be used", "check it") from error
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):  # such as a closed pipe
            raise
        _write_nowhere()
        cure = "redirect it to a file on another disk"
        raise UsageError(f"{error.strerror!r} while writing the output", "a disk with room", cure) from error
