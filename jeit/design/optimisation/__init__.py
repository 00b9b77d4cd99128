"""Layout optimisation: electrodes moved by gradients within constraints."""
