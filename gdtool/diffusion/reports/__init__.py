"""Report on models: model card, loss curve, validation images, cost plan and consistency figures."""
