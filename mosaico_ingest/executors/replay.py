"""This file makes the configurations that ingest what lies in a quarantine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mosaico_ingest.config import QuarantineSettings, ROSInjectionConfig, TimeRange
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.policies import IfExists
from mosaico_ingest.quarantine.kept import Kept

__all__ = ["replay_config"]


def replay_config(kept: Kept, configs: Sequence[ROSInjectionConfig]) -> ROSInjectionConfig:
    """Return the configuration of a sequence, for the messages kept of it: all of them, added to what is there.

    What fails again is kept again, beside the rest.

    Raises:
        ManifestError: None of the configurations is for that sequence.
    """
    known = {config.sequence_name: config for config in configs}
    if kept.sequence not in known:
        names = ", ".join(sorted(known)[:8])
        raise ManifestError(
            f"{kept.messages.name} belongs to the sequence {kept.sequence!r}, which the manifest does not make",
            where=configs[0].where,
            hint=f"it makes {names}",
        )
    config = known[kept.sequence]
    return replace(
        config,
        file_path=kept.messages,
        if_exists=IfExists.APPEND,
        topics=(),
        every={},
        time_range=TimeRange(),
        quarantine=config.quarantine or QuarantineSettings(kept.messages.parent),
        plan_digest=None,
    )
