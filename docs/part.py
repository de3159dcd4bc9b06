"""Print the pages that a build of one part runs, ``python docs/part.py K/N``, or what has changed.

To run the code of all pages takes minutes. With ``QUELL_DOCS_PART=K/N`` a build runs the K-th of N
parts of them, and all pages that have changed in the four hours before the last commit; the other
pages show their code without its results. ``python docs/part.py --changed`` prints all files of the
repository that have changed in that time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from measured import part_of

HERE = Path(__file__).parent


def _git(*arguments: str) -> str:
    """Return what git prints; nothing outside of a repository."""
    done = subprocess.run(
        ["git", *arguments], cwd=HERE, capture_output=True, text=True, check=False
    )
    return done.stdout.strip()


def changed() -> set[str]:
    """Return the files that have changed in the four hours before the last commit."""
    last = _git("log", "-1", "--format=%ct")
    since = f"--since={int(last) - 4 * 3600}" if last else "--max-count=0"
    return {*_git("log", since, "--format=", "--name-only").splitlines()} - {""}


def chosen(part: slice) -> list[str]:
    """Return the names of the pages of a part, as ``part_of`` has it, with the changed ones."""
    pages = sorted(path.stem for path in HERE.glob("*.md"))
    mine = {*pages[part]} | {Path(each).stem for each in changed()}
    return [page for page in pages if page in mine]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("part", nargs="?", type=part_of, metavar="K/N", help="print its pages")
    which.add_argument("--changed", action="store_true", help="print the files that have changed")
    options = parser.parse_args()
    print("\n".join(sorted(changed()) if options.changed else chosen(options.part)))
