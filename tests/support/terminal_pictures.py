"""Pictures of the terminal for the documentation: `./dev screenshots` writes them to docs/images."""

from __future__ import annotations

import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from terminal import captured, terminal_picture

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
WIDTH = 104
PICTURES = {
    "terminal-run": "ingest quickstart/quickstart.yaml",
    "terminal-show": "ingest store show quickstart_drive",
    "terminal-plot": "ingest store plot quickstart_drive/odom pose.position",
    "terminal-lint": "ingest lint job.yaml",
}
"""The command of each picture, in the order in which they run."""
MISTAKE = """version: 1
bag: {path: drive.mcap}
sequence: {name: drive}
topic_settings: {"/cam*": {every: two}}
"""


def take_pictures(folder: Path) -> Iterator[tuple[str, str]]:
    """Run the commands in a folder with the quickstart, and yield the name and the SVG of each picture."""
    captured(["-m", "mosaico_ingest", "quickstart"], WIDTH, folder)
    shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", folder)
    (folder / "job.yaml").write_text(MISTAKE)
    for name, command in PICTURES.items():
        output = captured(["-m", "mosaico_ingest", *shlex.split(command)[1:]], WIDTH, folder, codes={0, 12})
        yield name, terminal_picture(output, command=command, width=WIDTH)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for name, picture in take_pictures(Path(folder)):
            (IMAGES / f"{name}.svg").write_text(picture, encoding="utf-8")
            sys.stdout.write(f"wrote {name}.svg\n")
