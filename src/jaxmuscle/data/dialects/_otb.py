"""OTBioLab (OT Bioelettronica): .mat."""

import re

import numpy as np

from .._recording_channels import Channel
from ._dialect import Content, Dialect, columns_of, number, texts, upright

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
    columns = [column for part in map(upright, parts) for column in part.T]
    if rate is None or len(columns) != len(labels) or not columns:
        return None
    matches = [_UNIT.fullmatch(label) for label in labels]
    names = [match[1] if match else label for match, label in zip(matches, labels, strict=True)]
    units = [re.sub(r"[()]", "", (m[2] or m[3] or "") if m else "").strip() for m in matches]
    found = columns_of("Data", columns, rate, names, units)
    return found, ["Data", "Description", "SamplingFrequency"]


OTB = Dialect(mat=_mat)
