"""Training of patch networks: HardNet, L2-Net, GeoDesc and AffNet, on photographs and rendered scenes."""
