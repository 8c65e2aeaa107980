"""The network as compiled kernels: `acting` and `cpu` (learning) in C++, `gpu` in Triton.

What they compute is said by `learner.stepping` in numpy, and by `learner.vmdnn` and `learner.loss`
in PyTorch. These serve where no kernel can be had, and the kernels are tested against them.
"""
