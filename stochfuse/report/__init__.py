"""Reports format predictions; they compute nothing."""
