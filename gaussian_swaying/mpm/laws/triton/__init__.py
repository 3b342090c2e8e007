"""The laws as Triton functions of one particle per lane, a file for each law, and how kernels choose among them."""
