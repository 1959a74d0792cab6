"""Numbers about schemes: growth, spectra, costs, trials."""
