"""Imaging of successive frames in bounded time: `Imager`, and `stream`, which also handles faulty frames."""
