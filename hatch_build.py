"""The page of the package: the README, whose links lead to files that are not there."""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURE = re.compile(r"!\[([^\]]*)\]\((?!https?://)[^)]*\)")
LINK = re.compile(r"\[([^\]]*)\]\((?!https?://)[^)]*\)")


class CustomMetadataHook(MetadataHookInterface):
    """Puts words in the place of relative links, and what a picture shows in that of a picture."""

    def update(self, metadata: dict) -> None:
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        text = LINK.sub(r"\1", PICTURE.sub(r"*Figure: \1.*", text))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
