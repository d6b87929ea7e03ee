#!/bin/sh
# argparse-manpage 4.8: help that begins with a dot is missing in the page; roff takes the line for a request.
#
# Expected: man shows the help of both arguments, as `--help` does.
# Found: that of the second is missing, and groff warns of a macro that is not defined.
set -eu
command -v groff > /dev/null || { echo "needs groff: apt install groff"; exit 1; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check argparse-manpage==4.8

cat > "$work/program.py" <<'PYTHON'
import argparse


def parser():
    made = argparse.ArgumentParser("program", description="Converts.")
    made.add_argument("--to", help="a .png or .pdf file")
    made.add_argument("--from", help=".mcap or .bag files")
    return made
PYTHON
cd "$work"
venv/bin/argparse-manpage --pyfile program.py --function parser > program.1
groff -man -Tascii -P-c program.1 2> warnings | tr -s ' \n' ' ' > page
{
    venv/bin/pip list 2> /dev/null | grep argparse-manpage | tr -s ' '
    grep -q 'a .png or .pdf file' page && echo "help with a dot inside: shown"
    grep -q '.mcap or .bag files' page && echo "help that begins with a dot: shown" ||
        echo "help that begins with a dot: missing"
} > found
cat found
diff - found <<'END' || { echo "argparse-manpage writes such help in another manner now"; exit 1; }
argparse-manpage 4.8
help with a dot inside: shown
help that begins with a dot: missing
END
