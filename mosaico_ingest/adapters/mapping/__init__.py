"""The field-mapping language: parsed, typed, compiled to column operations; never evaluated as Python."""
