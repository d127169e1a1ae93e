"""Pack flat charts into the unit square: bit masks of charts, a search over orders, and compaction on a fine grid."""
