"""The substeps as Triton kernels, and what runs them; only imported where they are used.

For each formulation a file of kernels and a file that prepares the buffers and launches them, a subclass of
:class:`~gaussian_swaying.mpm.triton.fused.Fused`.
"""
