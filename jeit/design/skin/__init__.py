"""A skin and its touches: indentations, the cells they change, and the voltages that change with them."""
