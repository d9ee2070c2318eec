"""Readers of multi-view recordings, one module per file format; `neuido.data.read_recording` chooses the reader."""
