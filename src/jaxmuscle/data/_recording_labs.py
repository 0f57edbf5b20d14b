"""Recordings as laboratories save them: Excel, EDF, TDMS, AcqKnowledge, Spike2, by the libraries
for them. Run by `_apart_child` alone."""

import importlib
from typing import Any

from ._recording_channels import Channel, numbers
from ._recording_formats import unpacked


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        what = name.partition(".")[0]
        raise ImportError(f"reading this file needs {what}: pip install {what}") from None


def read_xlsx(path: str, most: int) -> dict[str, bytes]:
    """The sheets of a workbook as texts with tabs, in which rows keep their numbers."""
    _library("openpyxl")
    import pandas

    unpacked(path, most)
    with pandas.ExcelFile(path, engine="openpyxl") as book:
        names = [sheet.title for sheet in book.book.worksheets]  # there are sheets of charts, too
        sheets: dict[str, Any] = {name: book.parse(name, header=None) for name in names}
    if all(sheet.empty for sheet in sheets.values()):
        raise ValueError("it holds no sheet that is not empty")
    return {
        name: sheet.replace(r"\s+", " ", regex=True)
        .to_csv(sep="\t", header=False, index=False)
        .encode()
        for name, sheet in sheets.items()
    }


def read_edf(path: str, most: int) -> list[Channel]:
    """EDF and BDF: signals by their labels, with rates and units."""
    library = _library("edfio")
    with open(path, "rb") as file:
        read = library.read_bdf if file.read(1) == b"\xff" else library.read_edf
    signals = read(path, header_encoding="latin-1").signals  # though the format allows ASCII alone
    return [
        Channel(each.label, each.data, each.sampling_frequency, each.physical_dimension)
        for each in signals
    ]


def read_tdms(path: str, most: int) -> list[Channel]:
    """TDMS: channels by name, as `GROUP/NAME` where several groups have it; the rate is that of the
    waveform."""
    groups = _library("nptdms").TdmsFile.read(path).groups()
    found = [(group.name, channel) for group in groups for channel in group.channels()]
    names = [channel.name for _, channel in found]

    def read(group: str, channel: Any) -> Channel:
        name, step = channel.name, channel.properties.get("wf_increment")
        name = name if names.count(name) == 1 else f"{group}/{name}"
        unit = "s" if channel.dtype.kind == "M" else str(channel.properties.get("unit_string", ""))
        return Channel(name, numbers(channel[:]), 1 / step if step else None, unit)

    return [read(group, channel) for group, channel in found if channel.dtype.kind in "iufM"]


def read_acq(path: str, most: int) -> list[Channel]:
    """AcqKnowledge: channels by name, with rates and units."""
    file = _library("bioread").read_file(path)
    return [Channel(c.name, numbers(c.data), c.samples_per_second, c.units) for c in file.channels]


def read_smr(path: str, most: int) -> list[Channel]:
    """Spike2: waveform channels by name, with rates and units."""
    blocks = _library("neo.io").Spike2IO(filename=path).read_block(lazy=False).segments
    if len(blocks) != 1:
        raise ValueError(f"holds {len(blocks)} stretches with gaps between; save each on its own")
    channels: list[Channel] = []
    for group in blocks[0].analogsignals:
        names = group.array_annotations.get("channel_names", [group.name])
        rate, unit = (
            float(group.sampling_rate.rescale("Hz").magnitude),
            str(group.units.dimensionality),
        )
        channels += [
            Channel(str(name), group.magnitude[:, i], rate, unit) for i, name in enumerate(names)
        ]
    return channels
