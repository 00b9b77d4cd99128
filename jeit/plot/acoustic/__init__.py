"""Pictures of what microphones hear: receptive fields, maps, tracks, errors."""
