"""Many captures under many lights: what is to be done, who does it when, and how far it is."""
