"""Write results of the corpus again, with a reason, or list which are not the stored ones.

``python -m tests.golden.make``
    says what there is.
``python -m tests.golden.make --check [--part loops] [--only '017*']``
    lists what changed, and ends with 1 if something did.
``python -m tests.golden.make --part loops [--only '017*'] --reason "why they change"``
    lists it, writes it, and adds the reason to the file.
``python -m tests.golden.make --part loops --machines --reason "…"``
    also runs all cases with other code of BLAS, NumPy, the C library and LLVM; where the bits follow
    from these the case gets a ``why``, and numbers are compared in their place.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from typing import Any

from . import parts
from .corpus import cases_of, read, reason_of, write

# What a processor without vector units beyond SSE2 would run.
_SIMD = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR AVX2 FMA3 F16C AVX"
MACHINES: dict[str, dict[str, str]] = {
    "kernels of BLAS": {"OPENBLAS_CORETYPE": "Prescott"},
    "vector code of NumPy": {"NPY_DISABLE_CPU_FEATURES": _SIMD},
    "functions of the C library": {
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4_Usable"
    },
    "code of LLVM": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
}
"""Settings of a process, by what they exchange."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden.make", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--part", action="append", choices=[*parts.PARTS], default=[])
    parser.add_argument("--only", action="append", default=[], help="names, with * for any text")
    parser.add_argument("--reason", help="why results change; without it nothing is written")
    parser.add_argument("--check", action="store_true", help="list what changed")
    parser.add_argument("--machines", action="store_true", help="find bits that are the machine's")
    parser.add_argument("--workers", type=int, default=1, help="processes that run the cases")
    parser.add_argument("--times", action="store_true", help="print the CPU time of each case")
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    only = given.only or ["*"]
    if given.json:
        print(json.dumps(_outcomes(given.part[0], only)))
        return 0
    if not given.check and given.reason is None:
        if given.part or given.only or given.machines:
            parser.error(
                "--reason: missing; results are written with a reason only, or use --check"
            )
        _show()
        return 0
    if not given.check and not given.part:
        parser.error("--part: missing; results are written of the parts that are named")
    if given.reason is not None and (given.check or len(given.reason.split()) < 2):
        parser.error("--reason: must be a sentence, and goes without --check")
    named = given.part or [*parts.PARTS]
    unknown = [name for name in only if not any(parts.chosen(part, [name]) for part in named)]
    if unknown:
        parser.error(f"--only {unknown[0]!r}: no case of {', '.join(named)} has such a name")
    changed = [_renew(part, only, given) for part in named]
    return int(given.check and any(changed))


def _outcomes(part: str, only: list[str], times: bool = False) -> dict[str, Any]:
    """Return what the cases give now, by name."""
    found: dict[str, Any] = {}
    for case in parts.chosen(part, only):
        begin = time.process_time()
        found[case["name"]] = parts.run(part, case)
        if times:
            print(f"{time.process_time() - begin:7.2f} s  {case['name']}", flush=True)
    return found


def _in_processes(
    part: str, names: list[str], workers: int, settings: dict[str, str]
) -> dict[str, Any]:
    """Return what the cases give in other processes with these settings, by name."""
    command = [sys.executable, "-m", "tests.golden.make", "--json", "--part", part]
    environment, found = {**os.environ, **settings}, {}
    started = []
    for share in filter(None, (names[i::workers] for i in range(workers))):
        options = [each for name in share for each in ("--only", name)]
        process = subprocess.Popen(
            [*command, *options],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # whose share of the processor is its own
        )
        started.append(process)
    for process in started:
        out, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"{part}: a process with {settings} ended with {process.returncode}")
        found |= json.loads(out.splitlines()[-1])
    return found


def _show() -> None:
    """Print the parts, their sizes and their last reasons."""
    for part in parts.PARTS:
        written = read(part)["written"]
        last = f"{written[-1]['date']}: {written[-1]['reason']}" if written else "nothing is stored"
        print(f"{part:12} {len(cases_of(part)):4} cases, {last}")


def _renew(part: str, only: list[str], given: argparse.Namespace) -> bool:
    """List what changed in a part, and write it unless it is only checked."""
    cases, changed = parts.chosen(part, only), []
    begin = time.process_time()
    names = [case["name"] for case in cases]
    if given.workers > 1:
        outcomes = _in_processes(part, names, given.workers, {})
    else:
        outcomes = _outcomes(part, names, given.times)
    seconds = time.process_time() - begin
    whys = _machines(part, outcomes, given.workers) if given.machines else {}
    for case in cases:
        name = case["name"]
        told = parts.changes(part, case, outcomes[name])
        if name in whys and whys[name] != case.get("why", "") and not case.get("fixed"):
            told = [*told, f"its bits are {whys[name] or 'those of quell alone'}"]
        if told:
            changed.append(name)
            print(f"{part} {name}:", *told, sep="\n    ")
    print(f"{part}: {len(changed)} of {len(cases)} changed, {seconds:.1f} s of CPU")
    if given.check or not changed:
        return bool(changed)
    # With a why more numbers are stored: run these again.
    for case in cases:
        name = case["name"]
        if name not in changed:
            continue
        if "error" in outcomes[name]:
            print(f"{part} {name}: is not written: {outcomes[name]['error']}")
            continue
        if whys.get(name):
            case["why"] = whys[name]
        elif name in whys and not case.get("fixed"):
            case.pop("why", None)
        case["stored"] = parts.run(part, case) if whys.get(name) else outcomes[name]
    content = dict(read(part))
    content["written"] = [
        *content["written"],
        reason_of(changed if only != ["*"] else ["*"], given.reason),
    ]
    write(part, content)
    return True


def _machines(part: str, outcomes: dict[str, Any], workers: int) -> dict[str, str]:
    """Return why bits of cases are the machine's, or an empty text, by name."""

    def differing(names: list[str], settings: dict[str, str]) -> list[str]:
        """Return which of some cases have other bits in a process with these settings."""
        others = _in_processes(part, names, workers, settings)
        return [
            name for name in names if others[name].get("quarters") != outcomes[name].get("quarters")
        ]

    everything = {key: value for settings in MACHINES.values() for key, value in settings.items()}
    found: dict[str, list[str]] = {name: [] for name in outcomes}
    suspects = differing([*outcomes], everything)
    for what, settings in MACHINES.items() if suspects else ():
        for name in differing(suspects, settings):
            found[name].append(what)
    for name in suspects:
        found[name] = found[name] or ["code of BLAS, NumPy, the C library or LLVM"]
    return {name: ", ".join(whats) for name, whats in found.items()}


if __name__ == "__main__":
    sys.exit(main())
