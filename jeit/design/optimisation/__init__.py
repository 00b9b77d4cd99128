"""Layout optimisation: electrodes are moved along gradients of a layout score, within constraints."""
