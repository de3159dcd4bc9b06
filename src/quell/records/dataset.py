"""The xarray form of a record, whose data frame has one row for each sample."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import xarray


class RecordDataset(xarray.Dataset):  # type: ignore[no-untyped-call]
    """A dataset whose vector channels become columns of a data frame, and not more rows."""

    __slots__ = ()

    def to_dataframe(self, dim_order: Sequence[Hashable] | None = None) -> Any:
        """Return a ``pandas.DataFrame`` over time, or over run and time.

        The entries of a vector channel are columns of their own, ``x[0]``, ``theta[x1]``; its
        ``attrs["units"]`` has the unit of each column.
        """
        flat: dict[Hashable, Any] = {}
        units: dict[str, str] = {}
        for name, values in self.data_vars.items():
            axis = f"{name}_index"
            unit = values.attrs.get("units", "1")
            if axis not in values.dims:
                flat[name], units[str(name)] = values, unit
                continue
            labels = values[axis].values.tolist()
            texts = [label if isinstance(label, str) else str(i) for i, label in enumerate(labels)]
            several = unit.split(", ")
            each = several if len(several) == len(texts) else [unit] * len(texts)
            for i, text in enumerate(texts):
                flat[f"{name}[{text}]"] = values.isel({axis: i}, drop=True)
                units[f"{name}[{text}]"] = each[i]
        frame = xarray.Dataset(flat).to_dataframe(dim_order)
        frame.attrs["units"] = units
        return frame
