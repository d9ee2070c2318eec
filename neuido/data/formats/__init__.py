"""Readers of multi-view recordings, one module a format; `neuido.data.scenes.readers.read` chooses among them."""
