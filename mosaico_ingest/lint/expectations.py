"""The mistakes in the expressions of a manifest that are visible without a recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.adapters.bridge import ROSBridge, outputs_of
from mosaico_ingest.contracts.expressions import (
    Rows,
    bind_expression,
    locator,
    message_rows,
    ontology_rows,
    syntax_findings,
    type_findings,
)
from mosaico_ingest.errors import AdapterError, BagError, ManifestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.expect import AllowedNames, Expectations, TopicExpectations
from mosaico_ingest.lint.job import Job
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver


def expectation_findings(job: Job) -> Iterator[Finding]:
    """Yield the mistakes of all expressions.

    Names are checked against the message type that `type` expects, if its definition is known, and against the columns
    of its ontology type.
    """
    expect = job.manifest.expect
    if expect is None:
        return
    for topic, entry in expect.topics.items():
        for text, expected in entry.fields.items():
            path = ("expect", "topics", topic, "fields", text)
            locate = locator(job.source.key_span(path), text)
            mistakes = syntax_findings(text, locate)
            if not mistakes:
                for message, ontology in _rows(job, expect, topic, entry):
                    expression, mistakes = bind_expression(text, message, ontology, locate)
                    if expression is not None:
                        mistakes = list(type_findings(expression, expected, locate))
                    if mistakes:
                        break
            yield from mistakes


def condition_findings(job: Job) -> Iterator[Finding]:
    """Yield the mistakes of `where` and `on_change` that do not depend on the message type."""
    for topic, settings in job.manifest.topic_settings.items():
        conditions = [] if settings.where is None else [(("where",), settings.where)]
        conditions += [(("on_change", position), text) for position, text in enumerate(settings.on_change)]
        for keys, text in conditions:
            span = job.source.span(("topic_settings", topic, *keys))
            yield from syntax_findings(text, locator(span, text))


def _rows(
    job: Job, expect: Expectations, topic: str, entry: TopicExpectations
) -> Iterator[tuple[Rows | None, Rows | None]]:
    """Yield the message type and the ontology type of each type that a topic is expected to have."""
    expected = entry.type
    if expected is None and (other := expect.entry_of(topic, "type")) is not None:
        expected = expect.topics[other].type
    if expected is None:
        return
    names = expected.one_of if isinstance(expected, AllowedNames) else expected
    resolver = _resolver(job)
    for name in (names,) if isinstance(names, str) else names:
        for version in (2, 1):
            try:
                definition = resolver.resolve(name, None, ros_version=version)
            except BagError:
                continue
            yield _rows_of_type(job, topic, definition)
            break


def _rows_of_type(job: Job, topic: str, definition: Definition) -> tuple[Rows | None, Rows | None]:
    """Return the messages and the ontology rows of a topic; an output of an adapter has only ontology rows."""
    adapters, message = job.manifest.adapters, message_rows(definition)
    try:
        bridge = ROSBridge(overrides=adapters.override, loaded=adapters.load, base_dir=job.folder)
        source, _, name = topic.rpartition("/")
        for output in outputs_of(bridge.resolve(source, definition.root).spec) if source else ():
            if output.output == name:
                return None, ontology_rows(output.bind(definition, message.struct).ontology)
        spec = bridge.resolve(topic, definition.root).spec
        if outputs_of(spec):
            return message, None
        return message, ontology_rows(spec.bind(definition, message.struct).ontology)
    except (AdapterError, BagError, ManifestError):
        return message, None


def _resolver(job: Job) -> TypeResolver:
    bag = job.manifest.bag
    custom = [
        (messages.package, Path(job.resolve(messages.path)), messages.store)
        for messages in bag.custom_msgs
        if job.is_expanded(messages.path)
    ]
    try:
        return TypeResolver(bag.ros_distro, custom)
    except BagError:  # other rules report definitions that cannot be used
        return TypeResolver(bag.ros_distro, [])
