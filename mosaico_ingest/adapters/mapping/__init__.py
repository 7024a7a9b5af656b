"""The mapping language: the text of an adapter file in, an adapter that computes on Arrow columns out.

A mapping passes through four stages; no text is ever evaluated as Python:

1. `expressions` parses the text of an expression to a syntax tree (`Name`, `Attribute`, `Call`, …).
2. `checker` resolves names against the message definition and infers the static type of every node. The result is a
   typed expression (`FieldAccess`, `FunctionCall`, …). Its `Analyzer` drives both stages for one file and collects
   findings with their location.
3. `compiler` checks that each expression fits its ontology column and builds the record: a tree of column plans,
   one per column, with a source each.
4. `evaluator` computes column plans over all rows of a batch, and `conversion` casts the results to the exact
   column types. Rows with values that do not fit are rejected; the other rows are evaluated again without them.

For example, `volts: cells[].voltage_mv * 0.001` for a column of type `list<float>`:

- parsed: `Call("*", (Attribute(EachElement(Name("cells")), "voltage_mv"), Literal(0.001)))`
- typed: `OpenList` opens the list `cells`, so `FieldAccess` and `FunctionCall` apply to its elements. The product has the
  type float16 with one open list (`axes=(None,)`): the width of a float literal adapts to its context.
- compiled: `ColumnPlan("volts", source=ExpressionSource(…))`; float16 fits float32.
- evaluated: one multiplication over the flat array of all elements of all rows; the list's offsets are then put back.

`loader` contains the entry points: `load_adapter` reads a file, `MappingSpec.bind` runs the stages for one message
definition and returns a `MappingAdapter`. `functions` contains the functions that expressions may call. The package must not depend on recordings or destinations.
"""
