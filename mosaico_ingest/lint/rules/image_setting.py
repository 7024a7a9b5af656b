"""The check of `image-setting`: an `image` setting for topics that are not images."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.adapters.adapter import IMAGE_TAG
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.job.fields import image_settings, reference_of
from mosaico_ingest.job.values import first_match, is_glob
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report `image` settings for topics whose built-in adapter in `override` does not produce images.

    The types of other topics are known only to plan and run, which report the same rule.
    """
    overrides = job.manifest.adapters.override
    for topic, setting in job.manifest.topic_settings.items():
        pattern = topic if is_glob(topic) else first_match(overrides, topic)
        adapter = BY_NAME.get(reference_of(overrides.get(pattern or "")))
        image = image_settings(setting.image).format
        if image != "raw" and adapter is not None and adapter.tag != IMAGE_TAG:
            message = f"image: {image} has no effect, because {topic} becomes {adapter.tag}, not {IMAGE_TAG}"
            yield Problem(message, job.key_span("topic_settings", topic, "image"), "remove the setting")


CHECK = Check("image-setting", job=check)
