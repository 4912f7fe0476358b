"""The stages of `pdhef learn`: each determines one part of a car from drives."""
