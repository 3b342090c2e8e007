"""How far a run is from a reference: Chamfer distance, Fréchet video distance; PSNR and SSIM are torchmetrics' own."""
