"""The substeps as Triton kernels, and the code that runs them; imported only where they are used.

Each formulation has a file of kernels, and a file with a subclass of :class:`~gaussian_swaying.mpm.triton.fused.Fused`
that prepares the buffers and launches the kernels.
"""
