"""Raw messages in, Arrow rows in the message's own shape out; a message that does not fit costs its row and no other.

    definition ── layout ───────────────┐
    batch ── locate ── places ── columns ── rows
             (clustered, lockstep, stepwise)

A layout is data. `locate` finds where each of its steps lies in all messages, without reading a value; `columns` then
copies every column in one go. What they do not vouch for goes through `rowwise`, whose word counts.
"""
