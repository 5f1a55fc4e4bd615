"""Who looks, and from where: pulse and elements, track, beam weights, what channels can see."""
