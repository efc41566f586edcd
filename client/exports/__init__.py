"""Export of states from a scene, folder or file to third-party formats, HTML players, recordings and videos."""
