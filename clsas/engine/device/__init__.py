"""OpenCL: devices, kernels, buffers, upsampling, sine and cosine."""
