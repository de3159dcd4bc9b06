"""Files that nobody vouches for: what they may cost, and how they are refused."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

import quell as ql
from quell.experiments.acc.loops import read as read_samples
from quell.files import MAX_SIZE
from quell.identification import read_record
from quell.realtime.recordings import LOOP_CHANNELS, MARK, SCHEMA, TOPIC, Header, load, row_channels
from quell.records import netcdf, netcdf_reader
from quell.setup import load as load_setup
from tests.mutations import mutated, write_seeds

from .cases import cases

HEADER = Header(row_channels((("status", 1),)), dt=0.01)
LOADERS: dict[str, Callable[..., Any]] = {
    "recording": load,
    "Trajectory": ql.Trajectory.load,
    "BatchTrajectory": ql.BatchTrajectory.load,
    "record": read_record,
    "samples": read_samples,
    "setup": load_setup,
}


def csv_text(*counters: float) -> str:
    """Return the text of a CSV recording with these counters."""
    lines = [",".join(("time", *HEADER.columns))]
    lines += [
        ",".join([f"{0.01 * k!r}", f"{k!r}", *["0.0"] * (HEADER.width - 1)]) for k in counters
    ]
    return "\n".join(lines) + "\n"


def mcap_file(path: Path, rows: int, compression: str, header: str = "") -> Path:
    """Write a recording of zeros as other tools do, perhaps compressed."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[compression], chunk_size=1 << 26)
        writer.start()
        schema = writer.register_schema(SCHEMA, "ros2msg", b"")
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for k in range(rows):
            row = np.zeros(HEADER.width)
            row[0] = k
            writer.add_message(channel, 2**64 - 1, MARK + row.tobytes(), 2**64 - 1)
        writer.add_metadata("quell", {"header": header or HEADER.to_json()})
        writer.finish()
    return path


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record in NetCDF."""
    path = tmp_path_factory.mktemp("saved") / "run.nc"
    log = np.arange(40.0).reshape(10, 4)
    channels = (("r", 1), ("y", 1), ("x", 2))
    ql.Trajectory(log=log, channels=channels, dt=0.01, plant="a lift").save(path)
    return path


def changed(saved: Path, path: Path, change: Callable[[h5py.File], None]) -> Path:
    """Return a copy of a NetCDF file in which something was changed."""
    shutil.copy(saved, path)
    with h5py.File(path, "a") as file:
        change(file)
    return path


@cases("name", LOADERS)
def test_a_file_that_is_not_there_or_no_file_gives_a_line_with_its_name(
    name: str, tmp_path: Path
) -> None:
    """Whoever reads it; a pipe that nobody writes to is not waited for."""
    os.mkfifo(tmp_path / "pipe")
    paths = [tmp_path / "nothing", tmp_path]
    if name in ("recording", "Trajectory", "BatchTrajectory"):
        paths.append(tmp_path / "pipe")
    for path in paths:
        with pytest.raises((ValueError, FileNotFoundError)) as refused:
            LOADERS[name](path)
        assert str(path) in str(refused.value)
        assert "can't be read" in str(refused.value)
        assert "\n" not in str(refused.value)


def test_a_counter_that_jumps_is_a_matter_of_size(tmp_path: Path) -> None:
    """A few lines of text do not become gigabytes; whoever wants them says so."""
    path = tmp_path / "run.csv"
    path.write_text(csv_text(0.0, 30_000_000.0))
    with pytest.raises(
        ValueError, match=f"unpacks to more than max_size = {MAX_SIZE:g} MB; .*larger max_size"
    ):
        load(path)
    path.write_text(csv_text(0.0, 3e4))
    assert len(load(path)) == 30_001
    with pytest.raises(ValueError, match="max_size = 1 MB"):
        load(path, max_size=1.0)
    path.write_text(csv_text(0.0, 1e300))
    with pytest.raises(ValueError, match="not whole numbers that increase"):
        load(path)


@pytest.mark.parametrize("compression", ["ZSTD", "LZ4"])
def test_a_compressed_recording_is_read_up_to_the_limit(compression: str, tmp_path: Path) -> None:
    """Times at the end of their range are no obstacle; sizes that the file promises are not believed."""
    path = mcap_file(tmp_path / "run.mcap", 20_000, compression)
    size = 8e-6 * 20_000 * HEADER.width
    assert path.stat().st_size < 0.3e6 * size
    assert len(load(path)) == 20_000
    with pytest.raises(ValueError, match="unpacks to more than max_size = 1 MB"):
        load(path, max_size=1.0)
    # The chunk promises 100 bytes.
    content = path.read_bytes()
    at = content.index(compression.lower().encode()) - 16
    path.write_bytes(content[:at] + (100).to_bytes(8, "little") + content[at + 8 :])
    with pytest.raises(ValueError, match="it has no "):
        load(path)


def test_a_header_is_refused_in_a_line_if_it_is_none(tmp_path: Path) -> None:
    """Nested beyond what Python follows, or with rows of any width."""
    good = json.loads(HEADER.to_json())
    beside = tmp_path / "run.csv.json"
    (tmp_path / "run.csv").write_text(csv_text(0.0, 1.0))
    wide = [*map(list, LOOP_CHANNELS), ["x", 10**9]]
    for header, message in (
        ("[" * 100_000, "nested too deeply"),
        (json.dumps(good | {"channels": wide}), "must be at most 10000"),
        (json.dumps(good | {"channels": [["k", 1e400]]}), "width = inf: must be a whole number"),
        (
            json.dumps(good | {"channels": [[*LOOP_CHANNELS[0], 3]]}),
            "not that of a quell recording",
        ),
        (json.dumps(good | {"dt": 1e308}), "its times are beyond all numbers"),
        (json.dumps(good | {"dt": 10**400}), "must be a number up to 1.8e308"),
        (" " * 1_100_000, "at most 1 MB of settings"),
    ):
        beside.write_text(header)
        with pytest.raises(ValueError, match=message) as refused:
            load(tmp_path / "run.csv")
        assert "\n" not in str(refused.value)
    path = mcap_file(tmp_path / "run.mcap", 1, "NONE", "[" * 100_000)
    with pytest.raises(ValueError, match="nested too deeply"):
        load(path)


@pytest.fixture
def read_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read NetCDF files in this process, without limits: another one takes 0.15 s to start."""

    @contextmanager
    def reader(arguments: Sequence[str], most: int) -> Iterator[io.BytesIO]:
        answer = io.BytesIO()
        lists = ([*filter(None, text.split(","))] for text in arguments[2:])
        with monkeypatch.context() as patch:
            patch.setattr(netcdf_reader, "_limit_resources", lambda most: None)
            patch.setattr(sys, "stdout", SimpleNamespace(buffer=answer))
            netcdf_reader.main(arguments[0], most, *lists)
        answer.seek(0)
        yield answer

    monkeypatch.setattr(netcdf, "_reader", reader)


@pytest.mark.usefixtures("read_here")
def test_shapes_and_attributes_of_a_netcdf_file_are_checked_before_its_data(
    saved: Path, tmp_path: Path
) -> None:
    """What is declared counts, stored or not; other files and plugins are not touched."""

    def replaced(make: Callable[[h5py.File], object]) -> Callable[[h5py.File], None]:
        def change(file: h5py.File) -> None:
            del file["y"]
            make(file)

        return change

    outside = h5py.VirtualLayout((10,), "f8")
    outside[:] = h5py.VirtualSource("/etc/passwd", "y", (10,))
    for change, message in (
        (
            replaced(lambda file: file.create_dataset("y", (400_000_000,), "f8", chunks=(1000,))),
            f"unpacks to more than max_size = {MAX_SIZE:g} MB",
        ),
        (
            replaced(
                lambda file: file.create_dataset(
                    "y", (10,), "f8", maxshape=(None,), chunks=(10**8,)
                )
            ),
            "unpacks to more than",
        ),
        (replaced(lambda file: file.create_virtual_dataset("y", outside)), "data in other files"),
        (
            replaced(lambda file: file.create_dataset("y", (10,), "f8", external="/etc/passwd")),
            "data in other files",
        ),
        (
            replaced(lambda file: file.__setitem__("y", h5py.ExternalLink("/etc/passwd", "y"))),
            "a link to elsewhere",
        ),
        (
            replaced(lambda file: file.create_dataset("y", (10,), "f8", compression="lzf")),
            "compression",
        ),
        (replaced(lambda file: file.create_group("y")), "has groups"),
        (lambda file: file["y"].attrs.create("scale_factor", 2.0), "scaled numbers"),
        (lambda file: file.attrs.create("dt", np.zeros(10**4)), "no number and no text"),
        (lambda file: file.attrs.create("dt", 1e308), "its times are beyond all numbers"),
        (lambda file: file.attrs.create("every", 0), "every = 0: must be a whole number"),
        (
            lambda file: file.attrs.create("every", 10),
            "k = 0 to k = 2 the column time goes on by 0.02 s, by its attributes, dt = 0.01 s and "
            "every = 10, it is 0.2 s",
        ),
        (lambda file: file.attrs.__delitem__("dt"), "has no dt: it was not written by Traj"),
    ):
        path = changed(saved, tmp_path / "run.nc", change)
        with pytest.raises(ValueError, match=message) as refused:
            ql.Trajectory.load(path)
        assert "\n" not in str(refused.value)


@pytest.mark.trial
def test_a_record_is_larger_than_its_limit_or_is_read(saved: Path, tmp_path: Path) -> None:
    """Recompressed by another tool it is the same record."""
    import xarray

    run = ql.Trajectory.load(saved)
    assert (run.names, run.plant) == (("r", "y", "x"), "a lift")
    np.testing.assert_array_equal(run.log, np.arange(40.0).reshape(10, 4))
    with pytest.raises(ValueError, match="max_size = 0.0001 MB"):
        ql.Trajectory.load(saved, max_size=1e-4)
    with xarray.open_dataset(saved, engine="h5netcdf") as data:
        encoding = {name: {"zlib": True, "dtype": "float32"} for name in data.data_vars}
        data.to_netcdf(tmp_path / "small.nc", engine="h5netcdf", encoding=encoding)
    np.testing.assert_array_equal(ql.Trajectory.load(tmp_path / "small.nc").log, run.log)


def test_a_file_that_keeps_hdf5_busy_is_given_up(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a limit of time, in a line."""
    monkeypatch.setattr(netcdf, "_PATIENCE", 0.0)
    with pytest.raises(ValueError, match="took more than 7.56 s of processor time, or 0 s by"):
        ql.Trajectory.load(saved)


@pytest.mark.skipif(os.name == "nt", reason="the stand-in is a shell script")
def test_a_file_at_which_the_reader_hangs_is_given_up_within_20_s(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the clock, though no processor time passes; docs/security says how long it takes."""
    assert 15.0 < netcdf._PATIENCE * netcdf_reader.processor_time(int(MAX_SIZE * 1e6)) <= 20.0
    program = tmp_path / "hangs"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o700)
    monkeypatch.setattr("sys.executable", str(program))
    monkeypatch.setattr(netcdf, "_PATIENCE", 0.02)
    with pytest.raises(ValueError, match=r"or 0\.151 s by the clock"):
        ql.Trajectory.load(saved)


def test_the_reader_imports_nothing_from_the_folder_that_files_are_in(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module that came with the data is not run, as an interactive session would."""
    (tmp_path / "h5py.py").write_text("raise SystemExit('imported')")
    (tmp_path / "json.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert len(ql.Trajectory.load(saved)) == 10


@cases(
    "text",
    [
        "a" + ".a" * 3000 + " = 1",
        "[" + "a." * 400_000 + "a]",
        "a = " + "{a = " * 200 + "1" + "}" * 200,
        "a = " + "[" * 200 + "]" * 200,
        "dt = " + "1" * 5000,
        "#" * 1_100_000,
    ],
)
def test_a_setup_that_is_nested_or_long_beyond_measure_is_refused_in_a_line(
    text: str, tmp_path: Path
) -> None:
    """Within the time that an ordinary one takes."""
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(ql.setup.SetupError, match=r"^rig.toml: not a setup: [^\n]*$"):
        load_setup(tmp_path / "rig.toml")


def test_numbers_that_no_float_holds_are_refused_by_name() -> None:
    """JSON, TOML and Python know whole numbers of any length."""
    with pytest.raises(ValueError, match=r"omega = 10+…: must be a number up to"):
        ql.signals.Sinusoid(omega=10**400)
    with pytest.raises(ValueError, match="A: must be an array of numbers"):
        ql.plants.LinearPlant([[10**400]], [1.0], [1.0])


@pytest.mark.trial
def test_long_lines_and_long_files_of_numbers_are_refused(tmp_path: Path) -> None:
    """Both kinds of tables, before they are in memory."""
    path = tmp_path / "data.csv"
    path.write_text("t,u,y,m1,m2,k_lin,k_nonlin,lambda,tau\n" + "1," * 600_000)
    for read in (read_record, read_samples):
        with pytest.raises(ValueError, match="line 2 has more than 1000000 characters"):
            read(path)
    path.write_text("m1,m2,k_lin,k_nonlin,lambda,tau\n" + "1,1,1,0,1,0.1\n" * 30_000)
    assert read_samples(path).shape == (30_000, 6)
    with pytest.raises(ValueError, match="data.csv.*unpacks to more than max_size = 1 MB"):
        read_samples(path, max_size=1.0)
    path.write_text("\n".join(f"{k / 100},0,0" for k in range(20_000)))
    assert read_record(path).u.size == 20_000
    with pytest.raises(ValueError, match="data.csv.*unpacks to more than max_size = 0.5 MB"):
        read_record(path, max_size=0.5)


@pytest.mark.trial
def test_random_changes_of_files_are_read_or_refused_in_a_line(tmp_path: Path) -> None:
    """A short version of ``benchmarks/mutated_files.py``, without processes and commands."""
    valid = tmp_path / "valid"
    valid.mkdir()
    seeds, random_ = write_seeds(valid), random.Random(5)
    readers: dict[str, Callable[..., Any]] = {
        "recording in CSV": load,
        "recording in MCAP": load,
        "record": read_record,
        "samples": read_samples,
        "setup": load_setup,
        "setup of axes": load_setup,
    }
    results = Counter[bool]()
    for _ in range(240):
        kind = random_.choice([*readers])
        path = random_.choice(seeds[kind])
        other = random_.choice(seeds["setup"]).read_bytes()
        changed_ = tmp_path / path.name
        changed_.write_bytes(mutated(path.read_bytes(), kind, other, random_))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                readers[kind](changed_)
                results[True] += 1
            except ValueError as error:
                lines = getattr(error, "mistakes", (str(error),))
                assert all(line and "\n" not in line for line in lines), lines
                results[False] += 1
    assert min(results[True], results[False]) > 0
