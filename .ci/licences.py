"""Print the licence of every package that jeit or one of its extras needs, and exit with 1 if one is incompatible with
Apache-2.0.

Run `python .ci/licences.py` in an environment where jeit and its extras are installed. Packages that are not installed
are listed as such.
"""

import re
import sys
from importlib import metadata

from packaging.requirements import Requirement

# Licences compatible with Apache-2.0, and weak copyleft licences, which do not affect programs that only import a
# package.
FREE = ("Apache", "BSD", "MIT", "Python", "PSF", "ISC", "HPND", "MPL", "Mozilla", "Zlib", "Unlicense", "CC0", "0BSD")
WEAK = ("LGPL", "Lesser General Public")
# Exceptions, each with the reason why it is permitted: tools that contribute no code to jeit, and optional extras.
KNOWN = {
    "gmsh": "GPL-2.0-or-later: the extra 'mesh' alone imports it; what is given away with it is under the GPL.",
    **dict.fromkeys(
        ("mkl", "intel-openmp", "intel-cmplr-lib-ur", "tbb", "tcmlib", "umf"),
        "Intel Simplified Software License: closed, may be given away; the extra 'mkl' alone loads it.",
    ),
}


def licence_of(name: str) -> str:
    """Return the licence according to a package's metadata: the expression, else the classifiers, else the start of the
    text."""
    about = metadata.metadata(name)
    own = [one.rpartition(" :: ")[2] for one in about.get_all("Classifier", []) if one.startswith("License ::")]
    own = [one for one in own if one != "OSI Approved"]
    files = [one for one in metadata.files(name) or [] if re.match(r"(?i)licen[cs]e|copying", one.name)]
    text = about.get("License") or (files[0].locate().read_text("utf-8") if files else "")
    return about.get("License-Expression") or ", ".join(own) or " ".join(text.split())[:40] or "not given"


def needed(name: str, extras: set[str], seen: set[tuple[str, str]]) -> None:
    """Add to `seen` all dependencies of a package on this machine, recursively, with the extras of each."""
    for extra in {"", *extras}:
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        try:
            requirements = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        for one in map(Requirement, requirements):
            if one.marker is None or one.marker.evaluate({"extra": extra}):
                needed(re.sub(r"[-_.]+", "-", one.name).lower(), set(one.extras), seen)


def main() -> int:
    """Print all packages with their licences and return 1 if a licence is incompatible."""
    seen: set[tuple[str, str]] = set()
    needed("jeit", set(metadata.metadata("jeit").get_all("Provides-Extra", [])), seen)
    faults = 0
    for name in sorted({name for name, _ in seen} - {"jeit"}):
        try:
            licence, version = licence_of(name), metadata.version(name)
        except metadata.PackageNotFoundError:
            print(f"{name:28}{'not installed':14}{KNOWN.get(name, '')}")
            continue
        words = re.split(r"[^\w.]+", licence)
        good = any(word.startswith(FREE) for word in words) or any(one in licence for one in WEAK) or name in KNOWN
        faults += not good
        print(f"{name:28}{version:14}{licence}{'' if good else '  <- does it go with Apache-2.0?'}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
