#!/bin/sh
# MkDocs 1.6.1: a config in its own docs_dir is refused, but only where the config is named by its whole path.
#
# Expected: the same config builds, or is refused, however its path is written.
# Found: `-f docs/mkdocs.yml` builds; `-f "$PWD/docs/mkdocs.yml"` ends with 1, since docs_dir holds the config.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check mkdocs==1.6.1

mkdir -p "$work/project/docs"
cd "$work/project"
printf 'site_name: example\ndocs_dir: .\nsite_dir: ../site\n' > docs/mkdocs.yml
printf '# Example\n' > docs/index.md
relative=0; "$work/venv/bin/mkdocs" build -q -f docs/mkdocs.yml || relative=$?
absolute=0; "$work/venv/bin/mkdocs" build -q -f "$PWD/docs/mkdocs.yml" > "$work/refused" 2>&1 || absolute=$?
grep -o "'docs_dir' should not be the parent directory of the config file" "$work/refused" || true
echo "relative: $relative, absolute: $absolute"
[ "$relative" = 0 ] && [ "$absolute" = 1 ]
