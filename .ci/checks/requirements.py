"""Print requirements of ``pyproject.toml``: ``requirements.py some SEED|all|lowest|lowest-all``.

``some``: two extras, chosen by the seed; ``all``: all extras, separated by commas; ``lowest``: what
part of the tests needs, in the lowest versions; ``lowest-all``: all extras in the lowest versions.
"""

import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
extras = project["optional-dependencies"]
# Not: tools for developers, what has a driver of its own, and what is downloaded in gigabytes.
LEFT_OUT = ("test", "docs", "bench", "mutation", "dev", "ni", "torch", "jax")
names = [name for name in extras if name not in LEFT_OUT]


def lowest(of: tuple[str, ...]) -> str:
    """Return the lowest versions; an extra may need a later one of a package than quell itself."""
    versions: dict[str, str] = {}
    for each in (*project["dependencies"], *(line for name in of for line in extras[name])):
        package, version = each.split(">=")
        versions[package] = max(
            versions.get(package, version), version, key=lambda v: [*map(int, v.split("."))]
        )
    return "\n".join(f"{package}=={version}" for package, version in versions.items())


match sys.argv[1:]:
    case ["some", seed]:
        print("\n".join(names[(int(seed) + i) % len(names)] for i in range(2)))
    case ["all"]:
        print(",".join(names))
    case ["lowest"]:
        print(lowest(("control", "telemetry", "serial", "tuning", "cluster")))
    case ["lowest-all"]:
        several = ("control", "sklearn", "river", "telemetry", "serial", "cluster", "tuning")
        print(lowest((*several, "pandas", "fmi", "envs", "studio")))
    case _:
        sys.exit(__doc__)
