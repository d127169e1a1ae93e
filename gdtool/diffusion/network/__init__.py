"""Define the network: UNet, attention across views and domains, image encoder, codec, noise schedule and encodings."""
