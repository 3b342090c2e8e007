"""How far a run is from a reference: Chamfer and Fréchet video distance. PSNR and SSIM come from torchmetrics."""
