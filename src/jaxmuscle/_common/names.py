"""Names out of data (targets, people, columns) as names of files and folders, which stay in the
folder they are put into."""

import itertools
import re
import unicodedata
from collections.abc import Iterable, Sequence

LONGEST = 100  # bytes in UTF-8
_FORBIDDEN = '/\\:*?"<>|'
# of Windows
_RESERVED = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE
)


def file_name(name: str) -> str:
    """The name of a file on any system, in any folder.

    An underscore takes the place of each of `/ \\ : * ? " < > |`, of each letter that cannot be
    printed (control characters, NUL, halves of surrogate pairs), and of dots, dashes, tildes and
    blanks in front. Dots and blanks at the end are left out. Longer names are cut at 100 bytes.
    What is reserved by Windows (`con`, `nul.txt`, ...), or nothing, gets one in front.
    """
    text = unicodedata.normalize("NFC", name)
    text = "".join(
        "_" if letter in _FORBIDDEN or not letter.isprintable() else letter for letter in text
    )
    text = re.sub(r"^[-.~ ]+", lambda front: "_" * len(front[0]), text.rstrip(". "))
    text = f"_{text}" if not text or _RESERVED.fullmatch(text) else text
    return text.encode()[:LONGEST].decode(errors="ignore").rstrip(". ")


def file_names(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """The `file_name` of each of some names, all different, also where a system does not tell `A`
    from `a`.

    Where two would be equal, or one of `taken`, the later one gets `-2`, `-3`, ...; names that are
    file names as they are come first, then the others, each in their order.
    """
    names, used, found = list(names), {name.casefold() for name in taken}, dict[str, str]()
    for name in sorted(names, key=lambda name: file_name(name) != name):
        free, number = file_name(name), 1
        while free.casefold() in used:
            number += 1
            free = f"{file_name(name)}-{number}"
        used.add(free.casefold())
        found[name] = free
    return {name: found[name] for name in names}


def name_of_all(names: Sequence[str]) -> str:
    """What the names of trials have in common, without a number at the end, or how many trials
    there are."""
    if len(names) == 1:
        return names[0]
    letters = itertools.takewhile(lambda each: len(set(each)) == 1, zip(*names, strict=False))
    same = "".join(each[0] for each in letters)
    if any(name[len(same) :][:1].isdigit() for name in names):  # half of a number is none
        same = same.rstrip("0123456789")
    # a lone letter that stood before the numbers: S07_t1, S07_t2
    same = re.sub(r"(?<=.)[_\- .]+[A-Za-z]$", "", same)
    return same.rstrip("_- .") or f"{len(names)} trials"
