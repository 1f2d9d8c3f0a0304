"""The laws of the paper's figure 3, one a file; `hierarchy` wires them."""
