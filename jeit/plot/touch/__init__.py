"""Pictures of touch: contacts over an image, and every step that finds them."""
