"""Reader of NetCDF files that nobody vouches for, to be run as a process of its own.

HDF5 is written in C, and a file can make it loop, take all memory or crash. So the file is read in
a process that has limits of time and memory, attributes and declared shapes before any data::

    python -P -m quell.records.netcdf_reader PATH MOST AXES ATTRIBUTES VARIABLES

writes a line of JSON to its standard output, ``{"fault": …}`` or attributes and variables, and then
the values of the variables as they are in memory.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
from typing import Any

# Processor time [s]: for the start, and for each byte that may be unpacked. Decompression takes
# about 5 ns a byte here; the rest is for slower machines. Chosen by hand.
_START, _PER_BYTE = 5.0, 1e-8
# Memory beyond what may be unpacked [bytes]: HDF5's buffers and the largest variable as it is in
# the file. Chosen by hand.
_EXTRA_MEMORY = 256_000_000
# Variables, and bytes of an attribute or of all labels: many times as many as quell writes. Chosen
# by hand.
_MOST_VARIABLES, _MOST_TEXT = 1000, 1_000_000
# The filters that a file may have: deflate, shuffle and the checksum Fletcher-32. HDF5 would load
# others from plugins.
_FILTERS = {1, 2, 3}
# HDF5's mark of a dimension that has no variable (netCDF-4 specification, "Dimensions").
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"


class Fault(Exception):  # noqa: N818
    """Reason why a file was not written by quell, to follow its name."""


class TooLarge(Exception):  # noqa: N818
    """More data than is permitted."""


def processor_time(most: int) -> float:
    """Return the processor time that reading a file of ``most`` bytes may take [s]."""
    return _START + _PER_BYTE * most


_ATTRIBUTES = (
    *("dt", "every", "status", "ended", "limit", "plant"),
    *("signals", "u_min", "u_max", "axis_names", "axis_features"),
)


def main(path: str, most: int, axes: list[str], attributes: list[str], needed: list[str]) -> None:
    """Write what a file holds to the standard output, or the reason why it is refused.

    It must have the ``attributes``, and the ``needed`` variables.
    """
    out = sys.stdout.buffer
    begun = False
    try:
        import h5py

        _limit_resources(most)
        with h5py.File(path, "r") as file:
            found = _datasets(file, set(attributes), set(needed))
            description = _checked(file, found, axes, most)
            out.write(json.dumps(description).encode() + b"\n")
            begun = True
            for variable in description["variables"]:
                if "labels" not in variable:
                    values = found[variable["name"]][()]
                    out.write(values.astype(variable["dtype"], copy=False).data)
        out.flush()
    except Exception as error:  # whatever the libraries raise is the file's fault
        if begun:  # the reader of the output notices that it ends early
            sys.exit(1)
        kind = {Fault: "fault", TooLarge: "too large"}.get(type(error), "error")
        out.write(json.dumps({kind: " ".join(str(error).split()) or repr(error)}).encode() + b"\n")


def _limit_resources(most: int) -> None:
    """Limit this process's time, and its memory to what it has and some more."""
    try:
        import resource
    except ImportError:  # Windows: the parent's limit of time remains
        return
    seconds = math.ceil(processor_time(most))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    with contextlib.suppress(OSError, ValueError), open("/proc/self/statm") as file:  # noqa: PTH123
        memory = int(file.read().split()[0]) * resource.getpagesize() + 2 * most + _EXTRA_MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def _datasets(file: Any, attributes: set[str], needed: set[str]) -> dict[str, Any]:
    """Return the datasets of a file, and check that attributes and ``needed`` ones are there."""
    import h5py

    if len(file) > _MOST_VARIABLES or len(file.attrs) > _MOST_VARIABLES:
        raise Fault("has too many variables")
    found = {}
    for name in _names(file):
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise Fault(f"has a link to elsewhere ({name})")
        dataset = file[name]
        if not isinstance(dataset, h5py.Dataset):
            raise Fault(f"has groups ({name})")
        found[name] = dataset
    missing = sorted((needed - set(found)) | (attributes - set(file.attrs)))
    if missing:
        raise Fault(f"has no {', '.join(missing)}")
    return found


def _names(file: Any) -> list[str]:
    """Return the names in a file, in the order of their creation if the file knows it."""
    import h5py

    names: list[bytes] = []  # h5py 3.11 itself sorts those of a file that it reads
    try:
        file.id.links.iterate(names.append, idx_type=h5py.h5.INDEX_CRT_ORDER)
    except Exception:
        return list(file)
    return [name.decode() for name in names]


def _checked(file: Any, found: dict[str, Any], axes: list[str], most: int) -> dict[str, Any]:
    """Return attributes and variables; nothing but attributes and labels is read."""
    attributes = {name: _attribute(file, name) for name in _ATTRIBUTES if name in file.attrs}
    size, variables = 0, []
    for name, dataset in found.items():
        if _text_of(dataset, "NAME").startswith(_NO_VARIABLE):
            continue
        _check_storage(name, dataset, most)
        size += 8 * math.prod(dataset.shape)
        if size > most:
            raise TooLarge
        variables.append(_variable(name, dataset))
    # Coordinates follow from dt and the shapes, f_hat from its two shares; times may contradict dt.
    named = {"f_hat"}.union(*(variable["dims"] for variable in variables))
    left = named - {"time"}
    wanted = [each for each in variables if each["name"] not in left or "labels" in each]
    if not {*axes} <= named:
        raise Fault(f"has channels that are not over {' and '.join(axes)}")
    return {"attributes": attributes, "variables": wanted}


def _variable(name: str, dataset: Any) -> dict[str, Any]:
    """Return name, dimensions, type and shape of a variable; the labels if it is text."""
    import h5py

    described = {"name": name, "dims": _dimensions(name, dataset), "shape": list(dataset.shape)}
    if "parameter" in dataset.attrs:
        described["parameter"] = str(_attribute(dataset, "parameter"))
    if h5py.check_string_dtype(dataset.dtype) is not None:
        if 8 * dataset.size > _MOST_TEXT or dataset.dtype.itemsize > _MOST_TEXT:
            raise Fault(f"has too many labels ({name})")
        described["labels"] = [str(text) for text in dataset.asstr()[()].ravel()]
    elif dataset.dtype.kind in "iu":
        described["dtype"] = "<i8"
    elif dataset.dtype.kind == "f":
        described["dtype"] = "<f8"
    else:
        raise Fault(f"has a variable that is not numbers ({name})")
    return described


def _dimensions(name: str, dataset: Any) -> list[str]:
    """Return the names of a variable's dimensions."""
    if dataset.is_scale and dataset.ndim == 1:
        return [name]
    dims = [[scale.name.rpartition("/")[2] for scale in axis.values()] for axis in dataset.dims]
    if not all(dims):
        raise Fault(f"has a dimension without a name ({name})")
    return [names[0] for names in dims]


def _check_storage(name: str, dataset: Any, most: int) -> None:
    """Check that a dataset is stored in the file itself, and in chunks that fit into memory."""
    plan = dataset.id.get_create_plist()
    if dataset.is_virtual or plan.get_external_count():
        raise Fault(f"has data in other files ({name})")
    if not {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= _FILTERS:
        raise Fault(f"has an unknown compression ({name})")
    if {"scale_factor", "add_offset"} & set(dataset.attrs):
        raise Fault(f"has scaled numbers ({name})")
    if dataset.chunks and math.prod(dataset.chunks) * dataset.dtype.itemsize > most:
        raise TooLarge


def _attribute(item: Any, name: str) -> Any:
    """Return a number or a text of an attribute."""
    import h5py

    stored = h5py.h5a.open(item.id, name.encode())
    if stored.get_storage_size() > _MOST_TEXT:
        raise Fault(f"has an attribute that is too long ({name})")
    value = item.attrs[name]
    if hasattr(value, "tolist"):
        value = value.tolist()
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, bytes):
        value = value.decode()
    if not isinstance(value, int | float | str):
        raise Fault(f"has an attribute that is no number and no text ({name})")
    return value


def _text_of(item: Any, name: str) -> str:
    return str(_attribute(item, name)) if name in item.attrs else ""


if __name__ == "__main__":
    file_path, most_bytes, *lists = sys.argv[1:]
    main(file_path, int(most_bytes), *([*filter(None, text.split(","))] for text in lists))
