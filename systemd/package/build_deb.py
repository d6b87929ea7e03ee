#!/usr/bin/env python3
"""Builds the Debian package from the wheel: a venv with all dependencies, and what the system needs.

It is built on the distribution that it is for, as the venv holds files for that Python and links to it:

    make deb                                            # in the source tree, as any user
    python3 build_deb.py corridor-0.1.0-py3-none-any.whl --out DIR

Needed: this Python with pip 22.3 or later, /usr/bin/python3 with venv, dpkg, binutils and the
package index. DEBFULLNAME and DEBEMAIL, or else git, name the maintainer. Why it is no debhelper
package: docs/decisions/0018-packages.md.
"""

import argparse
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from email.utils import formatdate
from pathlib import Path
from tempfile import TemporaryDirectory

HERE = Path(__file__).parent
HOME = "usr/lib/corridor"  # of the venv
PROGRAM = "/usr/bin/corridor"
# Files of dependencies that nothing here imports, relative to site-packages: 90 MB of 490.
UNUSED = (
    "gtsam/Data",
    "gtsam/tests",
    "gtsam/examples",
    "gtsam/notebooks",
    "gtsam_unstable",
    "gtsam.libs/libgtsam_unstable*",
    "numba/tests",
    "numba/cuda/tests",
    "numba/np/ufunc/tbbpool*",  # of parallel kernels; there are none
    "numba/np/ufunc/omppool*",
    "llvmlite/tests",
    "numpy/**/tests",
    "zstandard/_cffi*",  # of PyPy
    "apsw/tests",
    "apsw/sqlite_extra_binaries",
    "pip/_vendor/distlib/*.exe",
    "corridor-*.dist-info/direct_url.json",  # where the wheel was when this was built
)
PLACES = {  # of the files of `corridor install-unit`: a package has them in /usr, an administrator in /etc
    "etc/systemd/system": "lib/systemd/system",
    "etc/sysusers.d": "usr/lib/sysusers.d",
    "etc/tmpfiles.d": "usr/lib/tmpfiles.d",
    "etc/udev/rules.d": "lib/udev/rules.d",
}
COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/corridor",
    "zsh": "usr/share/zsh/vendor-completions/_corridor",
    "fish": "usr/share/fish/vendor_completions.d/corridor.fish",
}
APACHE = "/usr/share/common-licenses/Apache-2.0"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--out", type=Path, default=Path("."), help="folder of the .deb")
    parser.add_argument("--revision", default="1", help="of the package, counts builds of one version")
    options = parser.parse_args()
    missing = [tool for tool in ("dpkg-deb", "objdump") if shutil.which(tool) is None]
    if missing:
        parser.error(f"{', '.join(missing)} missing: apt install dpkg binutils")
    if not options.wheel.is_file():
        parser.error(f"{options.wheel} is no wheel; make wheel builds one")
    version = f"{options.wheel.name.split('-')[1]}-{options.revision}"
    with TemporaryDirectory(prefix="corridor-deb-") as folder:
        root = Path(folder) / "root"
        python = make_venv(root, options.wheel.resolve())
        remove_unused(root)
        packages = own_packages_needed(root)
        add_system_files(root, python)
        add_documents(root, python, version)
        built = pack(root, version, python, packages, options.out)
    print(f"{built}: {built.stat().st_size / 1e6:.0f} MB, {installed_kib(built) / 1024:.0f} MB installed")
    return 0


def run(*command: str | Path) -> str:
    """Its stdout. Ends the program where the command fails; its words are on stderr."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"build_deb: {error}")
    return done.stdout


def make_venv(root: Path, wheel: Path) -> Path:
    """The wheel and its dependencies, without a path of the build; the interpreter of the venv."""
    venv = root / HOME
    venv.parent.mkdir(parents=True)
    run("/usr/bin/python3", "-m", "venv", "--without-pip", venv)
    interpreter = Path("/usr/bin/python3").resolve()  # python3.11: the name whose packages these are
    for name in ("python", "python3", interpreter.name):
        (venv / "bin" / name).unlink(missing_ok=True)
        (venv / "bin" / name).symlink_to(interpreter if name == "python3" else "python3")
    python = venv / "bin" / "python3"
    pip = (sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check")
    run(*pip, "install", "--quiet", "--no-compile", wheel, "pip")
    for script in (venv / "bin").iterdir():
        if not script.is_symlink() and script.name != "corridor":
            script.unlink()
    for text in (venv / "bin" / "corridor", venv / "pyvenv.cfg"):
        text.write_text(text.read_text().replace(str(root), ""))
    (root / "usr/bin").mkdir()
    (root / PROGRAM.lstrip("/")).symlink_to("../lib/corridor/bin/corridor")
    return python


def site_packages(root: Path) -> Path:
    (site,) = (root / HOME / "lib").glob("python*/site-packages")
    return site


def remove_unused(root: Path) -> None:
    site = site_packages(root)
    for pattern in UNUSED:
        for path in list(site.glob(pattern)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
    for path in list(site.rglob("__pycache__")):
        shutil.rmtree(path)


def binaries(root: Path) -> Iterator[Path]:
    for path in sorted((root / HOME).rglob("*")):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as stream:
                if stream.read(4) == b"\x7fELF":
                    yield path


def own_packages_needed(root: Path) -> list[str]:
    """Debian packages of the libraries that the binaries load and do not bring along."""
    found = {path.name for path in binaries(root)}
    needed = set()
    for path in binaries(root):
        needed |= set(re.findall(r"NEEDED\s+(\S+)", run("objdump", "-p", path)))
    places = dict(re.findall(r"^\s+(\S+) \(.*\) => (\S+)$", run("/sbin/ldconfig", "-p"), re.MULTILINE))
    packages = set()
    for name in sorted(needed - found):
        if name not in places:
            sys.exit(
                f"build_deb: a dependency loads {name}, which is not on this machine: apt-file search {name}"
            )
        place = Path(places[name]).resolve()
        owner = subprocess.run(["dpkg", "-S", place], capture_output=True, text=True, check=False).stdout
        owner = owner or run("dpkg", "-S", str(place).removeprefix("/usr"))  # /lib is /usr/lib
        packages.add(owner.partition(":")[0])
    return sorted(packages)


def add_system_files(root: Path, python: Path) -> None:
    run(python, "-m", "service", "install-unit", "--root", root, "--program", PROGRAM)
    for source, place in PLACES.items():
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / source).rename(root / place)
    for folder in ("etc/systemd", "etc/udev"):
        (root / folder).rmdir()
    man = root / "usr/share/man/man1"
    run(python, "-m", "service", "man", man)
    for page in man.iterdir():
        compress(page)
    for shell, place in COMPLETIONS.items():
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_text(run(python, "-m", "service", "completion", shell))


def add_documents(root: Path, python: Path, version: str) -> None:
    documents = root / "usr/share/doc/corridor"
    documents.mkdir(parents=True)
    moment = formatdate(int(os.environ.get("SOURCE_DATE_EPOCH", time.time())), localtime=False).replace(
        "-0000", "+0000"
    )
    changes = documents / "changelog.Debian"
    changes.write_text(
        f"corridor ({version}) stable; urgency=medium\n\n"
        f"  * Version {version} of corridor.\n\n -- {maintainer()}  {moment}\n"
    )
    compress(changes)
    overrides = root / "usr/share/lintian/overrides/corridor"
    overrides.parent.mkdir(parents=True)
    shutil.copy(HERE / "lintian-overrides", overrides)
    licences = run(python, HERE / "licences.py")
    (documents / "copyright").write_text(
        f"Copyright of corridor: its contributors. Licensed under the Apache License 2.0, see {APACHE}.\n\n"
        "The package carries these packages of the Python Package Index. Their whole terms and notices are\n"
        f"below /{HOME}.\n\n{licences}"
    )


def compress(path: Path) -> None:
    with gzip.GzipFile(f"{path}.gz", "wb", compresslevel=9, mtime=0) as stream:
        stream.write(path.read_bytes())
    path.unlink()


def maintainer() -> str:
    """As dch of devscripts reads it."""
    name = os.environ.get("DEBFULLNAME") or run("git", "config", "user.name").strip()
    address = os.environ.get("DEBEMAIL") or run("git", "config", "user.email").strip()
    return f"{name} <{address}>"


def pack(root: Path, version: str, python: Path, packages: Sequence[str], out: Path) -> Path:
    for path in [root, *root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.parent == root / HOME / "bin" else 0o644)
    files = [path for path in sorted(root.rglob("*")) if path.is_file() and not path.is_symlink()]
    major, minor = re.findall(r"\d+", os.readlink(python))[:2]
    architecture = run("dpkg", "--print-architecture").strip()
    control = (
        (HERE / "control.in")
        .read_text()
        .format(
            version=version,
            architecture=architecture,
            maintainer=maintainer(),
            installed_kib=sum(path.stat().st_size for path in files) // 1024,
            python=f"python3 (>= {major}.{minor}~), python3 (<< {major}.{int(minor) + 1})",
            libc=os.confstr("CS_GNU_LIBC_VERSION").split()[1],  # type: ignore[union-attr]
            libraries=", ".join(name for name in packages if name != "libc6"),
        )
    )
    folder = root / "DEBIAN"
    folder.mkdir()
    (folder / "control").write_text(control)
    names = [path.relative_to(root) for path in files]
    sums = (
        f"{hashlib.md5(path.read_bytes()).hexdigest()}  {name}"
        for path, name in zip(files, names, strict=True)
    )
    (folder / "md5sums").write_text("\n".join(sums) + "\n")
    (folder / "conffiles").write_text("".join(f"/{name}\n" for name in names if name.parts[0] == "etc"))
    for script in ("postinst", "prerm", "postrm"):
        shutil.copy(HERE / script, folder)
        (folder / script).chmod(0o755)
    out.mkdir(parents=True, exist_ok=True)
    built = out / f"corridor_{version}_{architecture}.deb"
    run("dpkg-deb", "--root-owner-group", "-Zgzip", "--build", root, built)  # xz: minutes for a tenth
    return built


def installed_kib(package: Path) -> int:
    return int(run("dpkg-deb", "--field", package, "Installed-Size"))


if __name__ == "__main__":
    sys.exit(main())
