"""Layout optimisation: electrodes are moved along gradients of a score, within constraints."""
