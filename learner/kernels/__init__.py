"""The recurrent core as compiled kernels: `cpu` in C++, `gpu` in Triton.

What they compute is said in PyTorch by `learner.vmdnn` and `learner.loss`, which serve where no
kernel can be had, and against which the kernels are tested.
"""
