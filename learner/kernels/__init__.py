"""C++ kernels, compiled for the processor at hand, and their bindings."""
