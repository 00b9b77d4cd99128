"""The licence of every package that jeit needs, or that an extra asks for; 1 where one does not go with Apache-2.0.

`python .ci/licences.py`, in an environment where jeit and its extras are installed; what is not is named.
"""

import re
import sys
from importlib import metadata

from packaging.requirements import Requirement

# Such as may be used by what is under Apache-2.0; of weaker copyleft, that ask nothing of a program that imports them.
FREE = ("Apache", "BSD", "MIT", "Python", "PSF", "ISC", "HPND", "MPL", "Mozilla", "Zlib", "Unlicense", "CC0", "0BSD")
WEAK = ("LGPL", "Lesser General Public")
# Tools that write no part of jeit, and extras that a user asks for: named, with the reason why they may be used.
KNOWN = {
    "gmsh": "GPL-2.0-or-later: the extra 'mesh' alone imports it; what is given away with it is under the GPL.",
    **dict.fromkeys(
        ("mkl", "intel-openmp", "intel-cmplr-lib-ur", "tbb", "tcmlib", "umf"),
        "Intel Simplified Software License: closed, may be given away; the extra 'mkl' alone loads it.",
    ),
}


def licence_of(name: str) -> str:
    """As its metadata say: the expression, else the classifiers, else the first words of the text."""
    about = metadata.metadata(name)
    own = [one.rpartition(" :: ")[2] for one in about.get_all("Classifier", []) if one.startswith("License ::")]
    own = [one for one in own if one != "OSI Approved"]
    files = [one for one in metadata.files(name) or [] if re.match(r"(?i)licen[cs]e|copying", one.name)]
    text = about.get("License") or (files[0].locate().read_text("utf-8") if files else "")
    return about.get("License-Expression") or ", ".join(own) or " ".join(text.split())[:40] or "not given"


def needed(name: str, extras: set[str], seen: set[tuple[str, str]]) -> None:
    """All packages beneath one that are asked for on this machine, with the extras of each."""
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
    """Print them, and what is wrong."""
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
