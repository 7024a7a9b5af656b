"""Train on a stored sequence with PyTorch: one sample per image, with the motion of the robot at that time.

Run it from the folder of the repository, after `ingest configs/quickstart.yaml`:

    python configs/integrations/pytorch_samples.py mosaico quickstart_drive
"""

from __future__ import annotations

import io
import sys

import numpy as np
import torch
from PIL import Image
from torch.utils.data import DataLoader, Dataset

from mosaico_ingest import Store, align


class ImageAndMotion(Dataset[tuple[torch.Tensor, torch.Tensor]]):
    """Images of shape (3, height, width), uint8, and motions of shape (3,): speed, yaw rate, acceleration."""

    MOTION = ("odom.velocity.linear.x", "imu.angular_velocity.z", "imu.acceleration.x")

    def __init__(self, store: str, sequence: str) -> None:
        """Align the topics; images stay compressed in memory until they are used."""
        drive = Store.open(store, create=False).sequence(sequence)
        samples = align(
            {
                "image": drive.topic("/camera/image_raw/compressed").to_arrow(columns=["data"]),
                "imu": drive.topic("/imu").to_arrow(columns=["angular_velocity", "acceleration"]),
                "odom": drive.topic("/odom").to_arrow(columns=["velocity"]),
            },
            at="image",
            method="linear",
            tolerance="100 ms",
        )
        samples = samples.select(["image.data", *self.MOTION]).drop_null()
        motion = np.stack([samples.column(name).to_numpy() for name in self.MOTION], axis=1)
        self._motion = torch.from_numpy(motion.astype(np.float32))
        self._images = samples.column("image.data").combine_chunks()

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._motion)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return an image and the motion at its time."""
        image = Image.open(io.BytesIO(self._images[index].as_py())).convert("RGB")
        return torch.from_numpy(np.array(image)).permute(2, 0, 1), self._motion[index]


def main(store: str, sequence: str) -> None:
    """Fit a linear model for a few steps and print the loss."""
    samples = ImageAndMotion(store, sequence)
    loader = DataLoader(samples, batch_size=16, shuffle=True)
    images, motion = next(iter(loader))
    print(f"{len(samples)} samples, images {tuple(images.shape)}, motions {tuple(motion.shape)}")
    model = torch.nn.Sequential(
        torch.nn.AdaptiveAvgPool2d(8), torch.nn.Flatten(), torch.nn.Linear(3 * 8 * 8, motion.shape[1])
    )
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    for epoch in range(3):
        total = 0.0
        for images, motion in loader:
            loss = torch.nn.functional.mse_loss(model(images / 255), motion)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.item() * len(images)
        print(f"epoch {epoch}: mean squared error {total / len(samples):.4f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
