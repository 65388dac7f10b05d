"""Faster forms of what is defined elsewhere. Skip it on a first reading: a test says of each that it is the definition.

- `time_loop`: linear maps of a time loop, whose biases are known before it and whose gradients are formed after it.
- `recurrence`: the MLPs and the GRU of a filter in such a loop.
- `flow_loop`: the conditional flow in such a loop, with merged layers.
- `fusion`: elementwise operations fused into one kernel where an update is recorded for a GPU.
- `convolutions`: the convolutions of many frames on a CPU.
- `precision`: what stays in float32 in a mixed-precision training.
"""
