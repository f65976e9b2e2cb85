"""The statistical shape model: mean, modes, variances."""
