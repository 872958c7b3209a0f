//! The four cities of VIGOR, and the ground resolutions that their corrected labels assume.

/// A city whose labels are known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownCity {
    /// Name as VIGOR writes it; the name of its folder.
    pub name: &'static str,
    /// Ground size of a pixel that the corrected labels assume everywhere in the city, metres
    /// (SliceMatch, supplementary material, section A).
    pub resolution_m: f64,
}

/// VIGOR's cities, by name.
pub const CITIES: [KnownCity; 4] = [
    KnownCity { name: "Chicago", resolution_m: 0.111_262 },
    KnownCity { name: "NewYork", resolution_m: 0.113_248 },
    KnownCity { name: "SanFrancisco", resolution_m: 0.118_141 },
    KnownCity { name: "Seattle", resolution_m: 0.100_817 },
];

impl KnownCity {
    /// Finds a city by name; case, spaces, `-` and `_` do not matter (`new_york`, `seattle`).
    #[must_use]
    pub fn find(name: &str) -> Option<&'static Self> {
        let letters = |text: &str| -> String {
            text.chars().filter(|c| c.is_alphanumeric()).collect::<String>().to_ascii_lowercase()
        };
        let key = letters(name);
        CITIES.iter().find(|city| letters(city.name) == key)
    }
}

/// VIGOR's spelling of a city's name; other names stay as they are.
#[must_use]
pub fn canonical_name(name: &str) -> String {
    KnownCity::find(name).map_or(name, |city| city.name).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cities_are_found_as_people_write_them() {
        for text in ["NewYork", "new_york", "New York", "newyork"] {
            assert_eq!(canonical_name(text), "NewYork");
        }
        assert_eq!(canonical_name("seattle"), "Seattle");
        assert_eq!(canonical_name("Delft"), "Delft");
        assert!(KnownCity::find("York").is_none());
    }
}
