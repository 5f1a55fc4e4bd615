"""OpenCL: devices, kernels, buffers."""
