"""Pictures of designs: sensitivity maps, virtual taxels, electrodes on the move."""
