"""Frame after frame to images in bounded time: `Imager`, and `stream`, which looks after bad frames."""
