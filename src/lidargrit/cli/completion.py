"""Print a script by which bash, zsh or fish completes lidargrit's verbs, options and names."""

import argparse

EXAMPLES = """\
  lidargrit completion bash > ~/.local/share/bash-completion/completions/lidargrit
  lidargrit completion zsh > ~/.zfunc/_lidargrit            with fpath+=~/.zfunc before compinit in ~/.zshrc
  lidargrit completion fish > ~/.config/fish/completions/lidargrit.fish
"""

_KINDS = {"preset": "presets", "sensor": "sensors", "to": "sensors", "protocol": "protocols", "metrics": "metrics"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument(
        "shell", choices=["bash", "zsh", "fish"], help="shell to print the script for; start a new shell afterwards"
    )


def run(options: argparse.Namespace) -> None:
    """Print the script."""
    import shtab

    from lidargrit.cli import build_parser
    from lidargrit.cli._catalogue import entries

    parser = build_parser()
    for verb in parser.verbs():
        for action in verb._actions:
            if action.dest in _KINDS:
                action.choices = [entry["name"] for entry in entries(_KINDS[action.dest])]
            elif action.choices is None and action.nargs != 0 and action.type not in (int, float):  # then a place
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]  shtab looks for it there
    print(shtab.complete(parser, options.shell))
