"""Planning of undersampled series: what a camera rate makes of excited lines, and which rates are good for them."""
