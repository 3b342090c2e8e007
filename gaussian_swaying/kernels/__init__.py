"""Kernels that are written once, in Triton's language, and compiled for a GPU by Triton and for a CPU by LLVM."""
