"""The stages of `pdhef learn`: each finds one part of a car on drives."""
