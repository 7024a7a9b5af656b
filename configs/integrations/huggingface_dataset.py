"""Turn a stored sequence into a Hugging Face dataset, with decoded images and numbers at ten samples per second.

Run it from the folder of the repository, after `ingest configs/quickstart.yaml`:

    python configs/integrations/huggingface_dataset.py mosaico quickstart_drive drive_dataset
"""

from __future__ import annotations

import sys

from datasets import Dataset, Image, load_from_disk

from mosaico_ingest import Store, align


def sequence_dataset(store: str, sequence: str) -> Dataset:
    """Return one example per 100 ms: an image, position and acceleration; the Arrow columns are not copied."""
    drive = Store.open(store, create=False).sequence(sequence)
    samples = align(
        {
            "image": drive.topic("/camera/image_raw/compressed").to_arrow(columns=["data"]),
            "odom": drive.topic("/odom").to_arrow(columns=["pose.position.x", "pose.position.y"]),
            "imu": drive.topic("/imu").to_arrow(columns=["acceleration.x"]),
        },
        at="10 Hz",
        method="linear",
        tolerance="300 ms",
    )
    columns = {
        "timestamp_ns": "timestamp_ns",
        "image.data": "image",
        "odom.pose.position.x": "x",
        "odom.pose.position.y": "y",
        "imu.acceleration.x": "acceleration",
    }
    table = samples.select(list(columns)).rename_columns(list(columns.values()))
    return Dataset(table).cast_column("image", Image())


def main(store: str, sequence: str, folder: str) -> None:
    """Save the dataset, load it again, and print it."""
    sequence_dataset(store, sequence).save_to_disk(folder)
    dataset = load_from_disk(folder)
    print(dataset)
    print(dataset[0]["image"].size, round(dataset[0]["x"], 3))
    print(dataset.with_format("numpy", columns=["x", "y"])[:3]["x"].round(3))


if __name__ == "__main__":
    main(*sys.argv[1:])
