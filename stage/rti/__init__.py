"""Files of the relightable-image (RTI) community: polynomial texture maps and hemispherical harmonics, in bytes."""
