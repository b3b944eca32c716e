"""Whether images, lights and the surface that was solved from them fit together: the checks that find a wrong manifest."""
