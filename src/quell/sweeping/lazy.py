"""The results of a sweep as one ``xarray.Dataset`` that reads its files when values are needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quell.sweeping.store import Store, parameter_variable

if TYPE_CHECKING:
    import xarray

NOT_DONE = -2
"""Status of a run that the sweep has not done yet."""


def lazy_dataset(store: Store) -> xarray.Dataset:
    """Return the dataset of a sweep over ``run``; values are read when they are used."""
    import xarray

    def over_runs(stored: str, dtype: Any, fill: Any, attributes: Any, read: Any = None) -> Any:
        array = _array(store, stored, np.dtype(dtype), fill, read)
        return xarray.Variable("run", array, attributes)

    variables = {
        name: over_runs(name, np.float64, np.nan, about) for name, about in store.measures.items()
    }
    about = "all status flags of the run (quell.Status); -1 for an error, -2 if it is not done"
    variables["status"] = over_runs("status", np.int32, NOT_DONE, {"long_name": about})
    variables["ended"] = over_runs(
        "ended", np.float64, np.nan, {"long_name": "when the run ended", "units": "s"}
    )
    variables["seed"] = over_runs("seed", np.int64, 0, {"long_name": "seed of the run"})
    about = "why the run has the status -1"
    variables["message"] = over_runs("error", object, "", {"long_name": about}, _messages)
    coordinates = {}
    for name, texts in store.labels.items():
        stored, key = (
            parameter_variable(name),
            name if name not in variables else f"parameter_{name}",
        )
        if texts is None:
            coordinates[key] = over_runs(stored, np.float64, np.nan, {"parameter": name})
        else:
            width = f"<U{max(map(len, texts))}"
            coordinates[key] = over_runs(stored, width, "", {"parameter": name}, _texts(texts))
    return xarray.Dataset(variables, coordinates, {"runs": store.runs, "folder": str(store.folder)})


def _array(store: Store, name: str, dtype: Any, fill: Any, read: Any) -> Any:
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class OverRuns(BackendArray):
        """A variable of all files of a sweep, read when it is indexed."""

        shape = (store.runs,)

        def __init__(self) -> None:
            self.dtype = dtype

        def __getitem__(self, key: Any) -> Any:
            support = indexing.IndexingSupport.BASIC
            return indexing.explicit_indexing_adapter(key, self.shape, support, self._values)

        def _values(self, key: tuple[Any, ...]) -> Any:
            return _read(store, name, dtype, fill, read or _numbers, key[0])

    # As those of xarray.open_dataset, values that were read stay in memory.
    cached: Any = indexing.MemoryCachedArray
    return cached(indexing.LazilyIndexedArray(OverRuns()))


def _read(
    store: Store,
    name: str,
    dtype: np.dtype[Any],
    fill: Any,
    read: Callable[..., NDArray[Any]],
    key: slice | int,
) -> Any:
    """Return the values of some runs."""
    import h5py

    wanted = np.arange(store.runs)[key]
    if wanted.size == 0:
        return np.empty(wanted.shape, dtype)
    low, high = int(np.min(wanted)), int(np.max(wanted)) + 1
    found = np.full(high - low, fill, dtype)
    for first, last in store.parts():
        if first >= high or last <= low or not store.file(first).exists():
            continue
        path = store.file(first)
        try:
            with h5py.File(path, "r") as file:
                values = read(file, name, first, last)
        except Exception as error:  # whatever HDF5 raises, the file is damaged or none of quell's
            why = " ".join(str(error).split())
            rule = "remove it, and the sweep does its runs again"
            raise ValueError(f"path = {str(path)!r}: can't be read ({why}); {rule}") from None
        begin, end = max(first, low), min(last, high)
        found[begin - low : end - low] = values[begin - first : end - first]
    return found[wanted - low]


def _numbers(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
    stored = file[name]
    if stored.shape != (last - first,) or stored.dtype.kind not in "fi":
        raise ValueError(f"{name} has shape {stored.shape}: must be ({last - first},) numbers")
    return np.asarray(stored[()])


def _messages(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
    found = np.full(last - first, "", object)
    places = np.asarray(file["error_run"][()]) - first
    if places.size > found.size or np.any((places < 0) | (places >= found.size)):
        raise ValueError("error_run has runs of another file")
    found[places] = file[name].asstr()[()] if places.size else ()
    return found


def _texts(texts: list[str]) -> Callable[..., NDArray[Any]]:
    def read(file: Any, name: str, first: int, last: int) -> NDArray[Any]:
        codes = _numbers(file, name, first, last)
        if np.any((codes < 0) | (codes >= len(texts))):
            raise ValueError(f"{name} has places outside of its list")
        return np.array(texts)[codes]

    return read
