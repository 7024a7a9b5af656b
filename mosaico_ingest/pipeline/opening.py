"""The opening of a job's recording, apart from the run, so that commands which only read import little."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from mosaico_ingest.job.model import Job
from mosaico_ingest.remote import with_network
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver
from mosaico_ingest.rosbag.recording import Recording, open_recording


@contextmanager
def open_job(job: Job) -> Generator[tuple[Recording, TypeResolver]]:
    """Open the recording of a job with the resolver for its message definitions.

    Raises:
        BagError: The recording cannot be opened.
    """
    custom = [(messages.package, Path(messages.path), messages.store) for messages in job.bag.custom_msgs]
    resolver = TypeResolver(job.bag.ros_distro, custom, registry=job.registry or ROSTypeRegistry)
    max_chunk_bytes = job.bag.max_chunk_size or MAX_CHUNK_BYTES
    paths = [with_network(path, job.network.limits) for path in job.paths]
    with open_recording(paths, resolve=resolver, max_chunk_bytes=max_chunk_bytes) as recording:
        yield recording, resolver
