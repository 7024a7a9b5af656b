"""The functions of the mapping language: Arrow columns in, one Arrow column out, one module per subject.

Functions keep no state and must not depend on the adapter that calls them.
"""

from mosaico_ingest.adapters.mapping.functions import lists, operators, ros, scalars
from mosaico_ingest.adapters.mapping.functions.registry import (
    ANY,
    BINARY,
    BOOLEAN,
    FLOAT,
    INTEGER,
    LIST,
    NUMBER,
    STRUCT,
    TEXT,
    TEXT_LITERAL,
    Function,
    function,
    functions,
    lookup,
)

__all__ = [
    "ANY",
    "BINARY",
    "BOOLEAN",
    "FLOAT",
    "INTEGER",
    "LIST",
    "NUMBER",
    "STRUCT",
    "SUBJECTS",
    "TEXT",
    "TEXT_LITERAL",
    "Function",
    "function",
    "functions",
    "lookup",
]

SUBJECTS = (operators, scalars, lists, ros)
"""Where the functions come from, in the order of the documentation."""
