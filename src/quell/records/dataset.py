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
        for name, values in self.data_vars.items():
            axis = f"{name}_index"
            if axis not in values.dims:
                flat[name] = values
                continue
            labels = values[axis].values.tolist()
            texts = [label if isinstance(label, str) else str(i) for i, label in enumerate(labels)]
            for i, text in enumerate(texts):
                flat[f"{name}[{text}]"] = values.isel({axis: i}, drop=True)
        frame = xarray.Dataset(flat).to_dataframe(dim_order)
        frame.attrs["units"] = {
            str(key): each.attrs.get("units", "1") for key, each in flat.items()
        }
        return frame
