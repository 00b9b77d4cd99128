"""Simulated skins that sound: the layer, the microphones under it, how sound spreads, and touches upon it.

A skin of another kind: `layer.ElastomerLayer`, `microphones.MicrophoneModel` and `microphones.Readout` are what a
`SoundingSkin` is made of.
"""
