"""Valid files of every kind that quell reads, and random changes of them."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

import quell as ql
from quell.realtime.recordings import (
    MARK,
    SCHEMA,
    TOPIC,
    Header,
    file_sink,
    row_channels,
    trajectory_of,
)
from quell.setup import EXAMPLES

HEADER = Header(
    row_channels((("x_hat", 2), ("f_residual", 1), ("f_learned", 1), ("status", 1), ("theta", 3))),
    dt=0.01,
    features=("x1", "x2", "bias"),
    device="a lift",
    units={"y": "m"},
)
OF_ONE = (("x_hat", 2), ("f_residual", 1), ("f_learned", 1), ("status", 1), ("theta", 2))
HEADER_OF_AXES = Header(
    row_channels(
        (
            *(("v", 2), ("status", 1)),
            *((f"{axis}.{name}", width) for axis in ("x", "y") for name, width in OF_ONE),
        ),
        ("load", "x.held"),
        *(2, 2),
    ),
    dt=0.01,
    device="a gantry",
    notes={
        "axes": {"x": ["x1", "bias"], "y": ["x1", "bias"]},
        "signals": {
            "axes": ["x", "y"],
            "y": ["way [m]", "way [m]"],
            "u": ["left [N]", "right [N]"],
        },
    },
)
"""Of two axes, with a channel of the device and one of an axis."""
NUMBER = re.compile(rb"(?<![\w.])[-+]?\d[\d_]*\.?\d*(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_][\w-]*")
# Values that are no good in most places, and some that are.
NASTY = [
    *("0", "-1", "1", "2", "3.5", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "1e-320"),
    *("9007199254740993", "9223372036854775807", "18446744073709551616", "1" * 400, "1" * 5000),
    *("", "1_000", "0x10", "1e5", "1000000", "100000000", "1e15", "true", "'x'", "[]", "{}"),
    *("[1.0, 2.0]", "[[1.0]]", "'none'", "none", '"', "\x00", "\ud7ff", "1,5", "1970-01-01"),
]
U64 = [0, 1, 8, 255, 2**16, 2**31, 2**32, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1]


def rows(header: Header = HEADER, count: int = 60) -> np.ndarray:
    """Return rows of a loop at which nothing happens."""
    made = np.zeros((count, header.width))
    made[:, 0] = np.arange(count)
    made[:, 3] = 1.0
    made[:, 5:9] = np.sin(0.1 * made[:, :1])
    return made


def write_seeds(folder: Path) -> dict[str, list[Path]]:
    """Write valid files; return them by kind. Names of those of axes begin with ``axes``."""
    names, headers = ("run", "axes"), (HEADER, HEADER_OF_AXES)
    for name, header in zip(names, headers, strict=True):
        for path in (folder / f"{name}.csv", folder / f"{name}.mcap"):
            sink = file_sink(path)
            sink.open(header)
            sink.write(rows(header))
            sink.close()
    for name, alone in (("run", "alone"), ("axes", "axes_alone")):
        (folder / f"{alone}.csv").write_bytes((folder / f"{name}.csv").read_bytes())
    mcap = [folder / f"{name}.mcap" for name in names]
    for compression in ("ZSTD", "LZ4", "NONE"):
        mcap.append(folder / f"{compression}.mcap")
        _write_mcap(mcap[-1], compression, HEADER)
    mcap.append(folder / "axes_LZ4.mcap")
    _write_mcap(mcap[-1], "LZ4", HEADER_OF_AXES)
    recordings = ("run", "alone", "axes", "axes_alone")
    return {
        "recording in CSV": [folder / f"{name}.csv" for name in recordings],
        "header": [folder / f"{name}.csv.json" for name in names],
        "recording in MCAP": mcap,
        "NetCDF": _write_netcdf(folder),
        "record": _write_records(folder),
        "samples": _write_samples(folder),
        "setup": _write_setups(folder),
        "setup of axes": _write_setups_of_axes(folder),
    }


def _write_mcap(path: Path, compression: str, header: Header) -> None:
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression], chunk_size=2000)
        writer.start()
        channel = writer.register_channel(
            TOPIC, "cdr", writer.register_schema(SCHEMA, "ros2msg", b"")
        )
        for row in rows(header):
            writer.add_message(channel, 10**18, MARK + row.tobytes(), 10**18)
        writer.add_metadata("quell", {"header": header.to_json()})
        writer.finish()


def _write_netcdf(folder: Path) -> list[Path]:
    import xarray

    channels = (("r", 1), ("y", 1), ("u", 1), ("status", 1), ("theta", 3))
    log = np.linspace(0.0, 1.0, 210).reshape(30, 7)
    run = ql.Trajectory(log, channels, 0.01, plant="a lift", features=HEADER.features)
    run.save(folder / "run.nc")
    one = np.ones(3)
    runs = ql.BatchTrajectory(
        np.stack([log] * 3), channels, 0.01, 1, 30 * one.astype(int), 0 * one.astype(int), one, one,
        "a lift", {"mass": one}, HEADER.features,
    )  # fmt: skip
    runs.save(folder / "runs.nc")
    with xarray.open_dataset(folder / "run.nc", engine="h5netcdf") as data:
        encoding = {name: {"zlib": True} for name in data.data_vars}
        data.to_netcdf(folder / "packed.nc", engine="h5netcdf", encoding=encoding)
    trajectory_of(HEADER_OF_AXES, rows(HEADER_OF_AXES)).save(folder / "axes.nc")
    return [folder / name for name in ("run.nc", "runs.nc", "packed.nc", "axes.nc")]


def _write_records(folder: Path) -> list[Path]:
    random_ = np.random.default_rng(3)
    u = np.sign(random_.standard_normal(300))
    y = np.convolve(u, 0.2 * 0.8 ** np.arange(30))[:300]
    cells = [
        [f"{0.01 * k:.2f}", f"{a:g}", f"{b:.6g}"] for k, (a, b) in enumerate(zip(u, y, strict=True))
    ]
    texts = {
        "named.csv": "t,u,y\n" + "\n".join(map(",".join, cells)),
        "plain.csv": "\n".join(",".join(row) + "," for row in cells),
        "tabs.csv": "# made by hand\nt\tu\ty\n" + "\n".join(map("\t".join, cells)),
        "german.csv": "t;u;y\n" + "\n".join(map(";".join, cells)).replace(".", ","),
    }
    for name, text in texts.items():
        (folder / name).write_text(text + "\n")
    return [folder / name for name in texts]


def _write_samples(folder: Path) -> list[Path]:
    names = ",".join(ql.experiments.acc.loops.COLUMNS)
    (folder / "samples.csv").write_text(f"{names}\n1,1,1,0,1,0.01\n1,1.1,0.9,-0.1,1,0.02\n")
    return [folder / "samples.csv"]


def _write_setups(folder: Path) -> list[Path]:
    made = [folder / path.name for path in EXAMPLES.glob("*.toml") if path.stem != "arm"]
    for path in made:
        path.write_bytes((EXAMPLES / path.name).read_bytes())
    base = "dt = 0.01\nplant = 'two-mass'\n[scenario]\nduration = 10.0\nreference = ['step', {kind = 'ramp', slope = 2.0}]\n[rig]\ndevice = 'twin:two-mass'\n[rig.safety]\nmost_error = 2.0\n"
    observer = "[observer]\nkind = 'model-free'\norder = 4\nb0 = 1.0\nomega_o = 9.0\n[controller]\nomega_c = 1.0\n"
    parts = (
        f"{observer}[learner]\nkind = 'rls'\nfeatures = ['state', {{kind = 'polynomial', degree = 2}}, 'input']\n",
        f"{observer}[learner]\nkind = 'harmonic'\ncount = 2\nomegas = [0.5, 1.5]\nlimits = [0.1, 3.0]\n",
        f"{observer}[learner]\nkind = 'gaussian-process'\n[prefilter]\nkind = 'zvd'\nomega = 1.4\n",
        f"{observer}[learner]\nkind = 'mlp'\n[guard]\ntime = 5.0\n",
        f"{observer}[prefilter]\nkind = 'reference-model'\nomega = 3.0\n",
        "[controller]\nkind = 'notch-pid'\nkp = 1.0\nnotch = {omega = 1.4, depth = 0.05}\n",
        "[controller]\nkind = 'lqg'\nomega_c = 1.0\nomega_o = 10.0\nu_max = 3.0\n",
        "[observer]\nkind = 'kalman'\norder = 4\nb0 = 1.0\nnoise_variance = 1e-6\ndrift = 1.0\n[controller]\nomega_c = 1.0\n[[metrics]]\nstart = 1.0\n",
    )
    for i, part in enumerate(parts):
        made.append(folder / f"setup{i}.toml")
        made[-1].write_text(base + part)
    return made


def _write_setups_of_axes(folder: Path) -> list[Path]:
    """Write setups of several axes; that of recordings is ``axes.toml``."""
    axis = "[[axis]]\nname = '{name}'\nobserver = {{kind = 'model-free', order = 2, omega_o = 15.0}}\n{more}\n"
    base = (
        "dt = 0.01\nplant = {kind = 'multivariable-linear', A = [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, -3]], "
        "B = [[0, 0], [5, 0.5], [0, 0], [0.4, 6]], C = [[1, 0, 0, 0], [0, 0, 1, 0]]}\n"
        "axes = {B0 = [[5, 0.5], [0.4, 6]], u_max = [20.0, 30.0], u_min = -25.0, actuators = ['left [N]', 'right [N]']}\n"
        "scenario = {duration = 0.5, disturbances = [0.0, {kind = 'step', at = 0.2}], seed = 3}\n"
        "[rig]\ndevice = 'twin:'\nchannels = ['load', 'x.held']\n[rig.safety]\nmost_error = [2.0, 3.0]\nu_max = [15.0, 9.0]\n"
    )
    law = "controller = {omega_c = 2.0}\nreference = {kind = 'step', height = 0.1}\nsignal = 'way [m]'"
    drive = "compensator = {omega_c = 2.0}\ndrive = {kp = 2.0, ki = 0.2, kd = 1.0, tf = 0.1}"
    learner = "learner = {kind = 'rls', features = ['state', 'bias']}\nguard = {bound = 40.0}"
    shared = "learner = {kind = 'rls', features = [{kind = 'all-axes', features = ['state']}]}"
    band = "controller = {omega_c = 2.0, safe_set = {y_min = -1.0, y_max = 1.0, rate_min = -3.0, rate_max = 3.0, alpha = 8.0, f_rate = 1.0}}"
    made = [folder / "axes_arm.toml"]
    made[0].write_bytes((EXAMPLES / "arm.toml").read_bytes())
    for name, more in (
        ("axes", law),
        ("axes_drives", drive),
        ("axes_learner", f"{law}\n{learner}"),
        ("axes_shared", f"{law}\n{shared}"),
        ("axes_bands", band),
    ):
        made.append(folder / f"{name}.toml")
        both = "".join(axis.format(name=each, more=more) for each in ("x", "y"))
        made[-1].write_text(base + both)
    return made


def mutated(content: bytes, kind: str, other: bytes, random_: random.Random) -> bytes:
    """Return a file's content with one to four random changes; ``other`` is one to splice with."""
    if kind == "header" and random_.random() < 0.5:
        return json.dumps(_other_json(json.loads(content), random_)).encode()
    binary = kind in ("NetCDF", "recording in MCAP")
    changes: list[Callable[[bytes, random.Random], bytes]]
    changes = [_flip, _truncate, _cut, _repeat]
    changes += [_number] * 4 if binary else [*[_nasty] * 8, _nest, _swap, _line]
    for _ in range(random_.choice((1, 1, 1, 2, 4))):
        if random_.random() < 0.05:
            content = (
                content[: random_.randrange(len(content) + 1)]
                + other[random_.randrange(len(other) + 1) :]
            )
        else:
            content = random_.choice(changes)(content, random_)
    return content


def _flip(content: bytes, random_: random.Random) -> bytes:
    """Change some bytes."""
    changed = bytearray(content)
    for _ in range(random_.choice((1, 2, 8, 32)) if changed else 0):
        changed[random_.randrange(len(changed))] = random_.choice((0, 255, random_.randrange(256)))
    return bytes(changed)


def _truncate(content: bytes, random_: random.Random) -> bytes:
    return content[: random_.randrange(len(content) + 1)]


def _cut(content: bytes, random_: random.Random) -> bytes:
    """Leave some bytes out."""
    at = random_.randrange(len(content) + 1)
    return content[:at] + content[at + random_.choice((1, 4, 100)) :]


def _repeat(content: bytes, random_: random.Random) -> bytes:
    """Repeat some bytes."""
    at, size = random_.randrange(len(content) + 1), random_.choice((1, 8, 200))
    return (
        content[:at] + content[at : at + size] * random_.choice((2, 3, 1000)) + content[at + size :]
    )


def _number(content: bytes, random_: random.Random) -> bytes:
    """Overwrite a number of 1 to 8 bytes."""
    size = random_.choice((1, 2, 4, 8))
    value = random_.choice((*U64, random_.getrandbits(64))) % 2 ** (8 * size)
    at = random_.randrange(max(len(content) - size, 0) + 1)
    return content[:at] + value.to_bytes(size, "little") + content[at + size :]


def _nasty(content: bytes, random_: random.Random) -> bytes:
    """Replace a number, sometimes a word, by a value that may be none."""
    found = list((NUMBER if random_.random() < 0.8 else WORD).finditer(content))
    if not found:
        return content
    at = random_.choice(found)
    return content[: at.start()] + random_.choice(NASTY).encode() + content[at.end() :]


def _nest(content: bytes, random_: random.Random) -> bytes:
    """Put brackets or parts of a key around or before something, often."""
    at, count = random_.randrange(len(content) + 1), random_.choice((2, 30, 2000, 20_000))
    opening, closing = random_.choice(
        (
            (b"[", b"]"),
            (b"{a=", b"}"),
            (b"a.", b""),
            (b'"', b""),
            (b"(", b")"),
            (b",", b""),
            (b"[{", b"}]"),
        )
    )
    return content[:at] + opening * count + closing * random_.choice((0, count)) + content[at:]


def _swap(content: bytes, random_: random.Random) -> bytes:
    """Exchange two words or numbers."""
    found = list((NUMBER if random_.random() < 0.5 else WORD).finditer(content))
    if len(found) < 2:
        return content
    a, b = sorted(random_.sample(found, 2), key=lambda match: match.start())
    return content[: a.start()] + b[0] + content[a.end() : b.start()] + a[0] + content[b.end() :]


def _line(content: bytes, random_: random.Random) -> bytes:
    """Leave a line out, repeat it, or move it."""
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    taken = lines.pop(random_.randrange(len(lines)))
    for _ in range(random_.choice((0, 1, 2))):
        lines.insert(random_.randrange(len(lines) + 1), taken)
    return b"".join(lines)


def _other_json(value: object, random_: random.Random) -> object:
    """Replace something in a JSON value."""
    if isinstance(value, dict) and value and random_.random() < 0.9:
        key = random_.choice([*value])
        if random_.random() < 0.15:
            return {k: v for k, v in value.items() if k != key}
        return {**value, key: _other_json(value[key], random_)}
    if isinstance(value, list) and value and random_.random() < 0.9:
        i = random_.randrange(len(value))
        return [*value[:i], _other_json(value[i], random_), *value[i + 1 :]]
    nasty = [None, True, 0, -1, 1.5, 10**9, 10**18, 10**400, 1e308, float("nan"), float("inf")]
    return random_.choice([*nasty, "", "x" * 10_000, [], {}, [[]], {"a": {}}, [1] * 1000, "k"])
