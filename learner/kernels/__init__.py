"""C++ kernels, compiled for this machine's processor, and their bindings: arrays in, arrays out."""
