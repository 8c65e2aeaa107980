"""What is simulated: the iCub with a right hand of our own, built from the official model."""
