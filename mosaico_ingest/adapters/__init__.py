"""Adapters: Arrow rows in the shape of a ROS type in, rows in the columns of an ontology type out.

The package contains the mapping language, the catalog of built-in adapters written in it, and adapters in Python.
It must not depend on containers, serialized messages or destinations.
`from mosaico_ingest.adapters import IMUAdapter` returns any built-in adapter as a class.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mosaico_ingest.adapters.python import ROSAdapterBase, register_default_adapter

__all__ = ["ROSAdapterBase", "register_default_adapter"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a class or a function
    """Import what `name` needs, and nothing before."""
    if name in __all__:
        from mosaico_ingest.adapters import python  # noqa: PLC0415 - on demand

        return getattr(python, name)
    if name.endswith("Adapter"):
        from mosaico_ingest.adapters.builtin import BY_NAME  # noqa: PLC0415 - on demand

        if name in BY_NAME:
            from mosaico_ingest.adapters.standalone import adapter_class  # noqa: PLC0415 - on demand

            return adapter_class(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    from mosaico_ingest.adapters.builtin import BY_NAME  # noqa: PLC0415 - on demand

    return sorted({*globals(), *__all__, *BY_NAME})
