"""Completion of the command line by argcomplete, in bash, zsh and fish."""

import argparse
from collections.abc import Iterator
from typing import Any

import argcomplete
from argcomplete.shell_integration import shellcode

from service.cli.console import print_result


def completion(parsed: argparse.Namespace) -> int:
    """`corridor completion SHELL`: the script that a shell reads."""
    script = shellcode(["corridor"], shell=parsed.shell)
    if parsed.json:
        print_result({"shell": parsed.shell, "script": script}, as_json=True)
    else:
        print(script)
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell, and end the process."""
    for action in _actions(parser):
        if (known := getattr(action.type, "known", None)) is not None:
            action.completer = lambda known=known, **_: known
    argcomplete.autocomplete(parser)


def _actions(parser: argparse.ArgumentParser) -> Iterator[Any]:
    """Of the parser and of all its commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
