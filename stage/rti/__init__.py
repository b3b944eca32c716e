"""File formats of reflectance transformation imaging (RTI): polynomial texture maps and hemispherical harmonics."""
