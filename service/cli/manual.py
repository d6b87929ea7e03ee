"""Manual pages (man 1) made from the parsers: one of the program, one of each command."""

import argparse
import re
from collections.abc import Iterator

from service.cli.console import print_result
from service.version import VERSION

WIDTH = 74  # of a synopsis; man fills all other text


def man(parsed: argparse.Namespace) -> int:
    """`corridor man DIR`: write the pages."""
    from service.cli.arguments import new_parser

    written = []
    parsed.folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages(new_parser()):
        path = parsed.folder / f"{name}.1"
        path.write_text(text, encoding="utf-8")
        written.append(str(path))
    print_result({"written": written}, parsed.json)
    return 0


def pages(parser: argparse.ArgumentParser, summary: str = "") -> Iterator[tuple[str, str]]:
    """Name and roff of each page, that of the program first.

    summary   of a command that has no description
    """
    name = parser.prog.replace(" ", "-")
    yield name, "\n".join(_page(name, parser, parser.description or summary))
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action._choices_actions:
                yield from pages(action.choices[command.dest], command.help or "")


def _page(name: str, parser: argparse.ArgumentParser, description: str) -> Iterator[str]:
    formatter = argparse.HelpFormatter(parser.prog, width=WIDTH)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups, prefix="")
    yield f'.TH {name.upper()} 1 "" "corridor {VERSION}" "corridor"'
    yield from (".SH NAME", _plain(f"{name} - {description.rstrip('.')}"))
    yield from (".SH SYNOPSIS", ".nf", _plain(formatter.format_help().strip("\n")), ".fi")
    for group in parser._action_groups:
        actions = [one for one in group._group_actions if one.help is not argparse.SUPPRESS]
        if not actions:
            continue
        is_commands = isinstance(actions[0], argparse._SubParsersAction)
        yield f".SH {'COMMANDS' if is_commands else _plain(str(group.title).upper())}"
        for action in actions:
            if isinstance(action, argparse._SubParsersAction):
                for command in action._choices_actions:
                    yield from _item(f"{parser.prog} {command.dest}", command.help or "")
            else:
                words = formatter._expand_help(action) if action.help else ""
                yield from _item(formatter._format_action_invocation(action), words)
    if parser.epilog:
        yield from (".SH NOTES", ".nf", _plain(parser.epilog), ".fi")
    yield ""


def _item(head: str, words: str) -> Iterator[str]:
    yield from (".TP", rf"\fB{_plain(head)}\fR", _plain(words) or r"\&")


def _plain(text: str) -> str:
    """Text that roff takes for text: no line of it is a request."""
    escaped = text.replace("\\", r"\e").replace("-", r"\-")
    return re.sub(r"^(?=[.'])", r"\\&", escaped, flags=re.MULTILINE)
