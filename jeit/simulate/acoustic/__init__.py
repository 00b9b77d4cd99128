"""Simulated skins that sound: the layer, the microphones under it, how sound spreads, and touches upon it."""
