"""Lei & Li 2017: the plant, its model and its identification in flight, the controller, the paths, the figures."""
