"""This file writes `distros.json` from the types that rosbags has of each distro."""

from __future__ import annotations

import json

from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.distros import FILE
from mosaico_ingest.rosbag.definitions.idl import message_type
from mosaico_ingest.rosbag.definitions.parser import spell

__all__ = ["distros_file"]


def distros_file() -> str:
    """Return the file: a line for each form of a type, with the distros that have it."""
    forms: dict[str, dict[str, list[str]]] = {}
    for distro in Stores:
        types = get_typestore(RosbagsStores(distro.value)).fielddefs
        for name in types if distro is not Stores.EMPTY else ():
            forms.setdefault(name, {}).setdefault(spell(message_type(name, types)), []).append(distro.value)
    known = {
        name: {" ".join(having): text for text, having in of_one.items()}
        for name, of_one in sorted(forms.items())
    }
    return json.dumps(known, indent=1) + "\n"


if __name__ == "__main__":
    FILE.write_text(distros_file(), encoding="utf-8")
