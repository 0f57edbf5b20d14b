"""OTBioLab (OT Bioelettronica): .mat."""

import re

import numpy as np

from .._recording_channels import Channel
from ._dialect import Content, Dialect, number, texts

_UNIT = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\((%?[^()]*(?:\([^()]*\))?)\))\s*")


def _mat(content: Content) -> tuple[list[Channel], list[str]] | None:
    """`Data` with a column for each line of `Description`, which ends in its unit: `acquired data[
    %(MVC)]`."""
    if not {"Data", "Description", "SamplingFrequency"} <= content.keys():
        return None
    rate = number(np.unique(np.ravel(content["SamplingFrequency"])))  # there may be one for each
    labels = texts(content["Description"])
    parts = content["Data"]
    parts = [np.asarray(part) for part in (parts if isinstance(parts, list) else [parts])]
    parts = list(parts[0]) if parts[0].dtype == object else parts
    columns = [column for part in map(_upright, parts) for column in part.T]
    if rate is None or len(columns) != len(labels) or not columns:
        return None
    found = []
    for i, (label, column) in enumerate(zip(labels, columns, strict=True)):
        match = _UNIT.fullmatch(label)
        name, unit = (match[1], match[2] or match[3] or "") if match else (label, "")
        unit = unit.replace("(", "").replace(")", "").strip()
        found.append(
            Channel(
                name or f"channel {i}",
                column,
                rate,
                unit,
                f"Data:{i}" if len(columns) > 1 else "Data",
            )
        )
    return found, ["Data", "Description", "SamplingFrequency"]


def _upright(part: object) -> np.ndarray:
    array = np.asarray(part)
    array = array.reshape(-1, 1) if array.ndim < 2 else array
    return array.T if array.shape[0] < array.shape[1] else array


OTB = Dialect(mat=_mat)
