"""Use of a trained field: queries, maps, prediction intervals and export."""
