"""Better layouts: electrodes moved by gradients within constraints."""
