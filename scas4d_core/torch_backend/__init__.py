"""The equations in plain torch: the float64 twins of the CPU kernels, and the update on a GPU."""
