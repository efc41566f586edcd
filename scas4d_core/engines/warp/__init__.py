"""GPU engine, built on float32 NVIDIA Warp kernels. For tests, the kernels also run (slowly) on Warp's CPU device.

``layout`` defines the structures that the rendering kernels share, and ``lanes`` defines warp-level primitives. The
kernels in ``projection``, ``supports``, ``tiles`` and ``blend`` render images, and ``picture_loss`` compares them with
training images. ``rasterizer`` and ``pictures`` launch these kernels, and ``renderer`` renders states. ``deformation``
launches the kernels that deform the Gaussians. ``engine`` runs updates, and ``fit`` runs fits.
"""
