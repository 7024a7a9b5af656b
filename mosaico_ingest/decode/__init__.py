"""Raw messages in, Arrow rows in the message's own shape out."""
