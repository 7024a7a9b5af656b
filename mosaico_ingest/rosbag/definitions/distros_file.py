"""Generates `distros.json` from the type stores of rosbags."""

from __future__ import annotations

import json

from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.model import spell
from mosaico_ingest.rosbag.definitions.registry import FILE
from mosaico_ingest.rosbag.definitions.rosbags_types import message_type


def distros_file() -> str:
    """Return the content of the file: per type, its forms and the distros that have each form."""
    forms: dict[str, dict[str, list[str]]] = {}
    for distro in Stores:
        types = get_typestore(RosbagsStores(distro.value)).fielddefs
        for name in types if distro is not Stores.EMPTY else ():
            forms.setdefault(name, {}).setdefault(spell(message_type(name, types)), []).append(distro.value)
    content = {
        name: {" ".join(distros): text for text, distros in texts.items()}
        for name, texts in sorted(forms.items())
    }
    return json.dumps(content, indent=1) + "\n"


if __name__ == "__main__":
    FILE.write_text(distros_file(), encoding="utf-8")
