#!/bin/sh
# MkDocs 1.6.1: with --quiet, --strict lets warnings pass.
#
# Expected: --quiet prints less; --strict ends with 1 at a warning with and without it.
# Found: a link to a missing anchor ends with 1, and with 0 as soon as --quiet is given.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check mkdocs==1.6.1 2> /dev/null

mkdir -p "$work/docs"
cd "$work"
printf 'site_name: example\nvalidation: {links: {anchors: warn}}\n' > mkdocs.yml
printf '# Example\n\n[there](other.md#nowhere)\n' > docs/index.md
printf '# Other\n' > docs/other.md
strict=0; venv/bin/mkdocs build --strict > /dev/null 2>&1 || strict=$?
quiet=0; venv/bin/mkdocs build --strict --quiet > /dev/null 2>&1 || quiet=$?
echo "$(venv/bin/mkdocs --version | cut -d ' ' -f 1-3)"
echo "--strict: $strict, --strict --quiet: $quiet"
[ "$strict" = 1 ] && [ "$quiet" = 0 ]
