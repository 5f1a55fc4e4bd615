"""How a device sees the data: devices, kernels, upsampling, sine and cosine."""
