"""Training of a render-and-compare refiner by the distance of the object's points."""
