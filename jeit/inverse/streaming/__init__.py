"""Imaging frame after frame in bounded time: `Imager`, and `stream`, which handles bad frames."""
