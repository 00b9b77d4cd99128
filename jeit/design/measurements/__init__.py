"""Which measurements are worth making: candidates, and the choice among them."""
