"""Change how quads are connected: rotate edges and collapse quads to remove irregular vertices and folds."""
