"""What a scheme does, in numbers: growth, spectra, costs, trials."""
