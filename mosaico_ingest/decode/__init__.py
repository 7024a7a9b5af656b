"""The decoder: message blocks and a message definition in, Arrow rows in the shape of the ROS type out.

A message that does not fit its definition becomes a rejected row and affects no other message. The package must not
depend on containers, adapters or destinations.

    definition ── layout ─────────────┐
    message block ── locate ── positions ── decoder ── rows

`layout` compiles a definition to a list of steps. `locate` finds the position of each step in all messages without
reading a value, and `decoder` then copies each column in one operation. Messages that these stages cannot verify fall
back to the row-wise decoder, which is authoritative.
"""
