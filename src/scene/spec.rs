//! What a scene file says: the TOML tables, their keys, units and defaults.
//!
//! Every key has a default, so that an empty file is a scene; unknown keys are refused. Values are
//! checked in `super::validate`.

use serde::{Deserialize, Serialize};

/// A whole scene file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneSpec {
    /// Name for messages and `scene.json`.
    pub name: String,
    /// Seed of everything random: the same seed gives the same bytes.
    pub seed: u64,
    /// Where the scene lies.
    pub place: PlaceSpec,
    /// How large it is.
    pub extent: ExtentSpec,
    /// Shape of the bare earth.
    pub terrain: TerrainSpec,
    /// Water along one side; none when the table is absent.
    pub water: Option<WaterSpec>,
    /// The street grid.
    pub streets: StreetSpec,
    /// What stands on the blocks between the streets.
    pub blocks: BlockSpec,
    /// Trees and shrubs.
    pub trees: TreeSpec,
    /// Cars, parked and driving.
    pub cars: CarSpec,
    /// The sun; without it the sky is overcast and nothing casts a shadow.
    pub sun: Option<SunSpec>,
    /// Where the satellite stands; without it straight above (an orthographic nadir view).
    pub view: Option<ViewSpec>,
    /// The lidar survey.
    pub lidar: LidarSpec,
    /// How the survey is delivered.
    pub tiles: TileSpec,
    /// The satellite images and the panorama positions.
    pub images: ImageSpec,
    /// One picture of the whole extent; none when the table is absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub picture: Option<PictureSpec>,
    /// What changed between the lidar's year and the images' year; nothing without the table.
    pub change: Option<ChangeSpec>,
    /// Air, lens and processing of the images; clear air and a perfect camera without the table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraSpec>,
    /// More of what real cities have; nothing of it without the table.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<DetailSpec>,
}

impl Default for SceneSpec {
    fn default() -> Self {
        Self {
            name: "scene".to_owned(),
            seed: 1,
            place: PlaceSpec::default(),
            extent: ExtentSpec::default(),
            terrain: TerrainSpec::default(),
            water: None,
            streets: StreetSpec::default(),
            blocks: BlockSpec::default(),
            trees: TreeSpec::default(),
            cars: CarSpec::default(),
            sun: None,
            view: None,
            lidar: LidarSpec::default(),
            tiles: TileSpec::default(),
            images: ImageSpec::default(),
            picture: None,
            change: None,
            camera: None,
            detail: None,
        }
    }
}

/// `[place]`: centre of the scene, WGS 84 (EPSG:4326). It must lie in the state of Washington,
/// where lidar is delivered in EPSG:2927.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlaceSpec {
    /// Latitude of the centre, degrees north.
    pub latitude_degrees: f64,
    /// Longitude of the centre, degrees east (negative in Washington).
    pub longitude_degrees: f64,
}

impl Default for PlaceSpec {
    fn default() -> Self {
        Self { latitude_degrees: 47.6097, longitude_degrees: -122.3331 }
    }
}

/// `[extent]`: size of the scene along the axes of EPSG:2927. Lidar covers it; images lie inside.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExtentSpec {
    /// Size from west to east, metres.
    pub width_metres: f64,
    /// Size from south to north, metres.
    pub height_metres: f64,
}

impl Default for ExtentSpec {
    fn default() -> Self {
        Self { width_metres: 280.0, height_metres: 280.0 }
    }
}

/// `[terrain]`: a plane plus a few smooth waves, differentiable everywhere.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainSpec {
    /// Mean height (NAVD88), metres.
    pub base_height_metres: f64,
    /// Height of the hills, from valley to top at most, metres; 0 is a plane.
    pub relief_metres: f64,
    /// Typical distance from hill to hill, metres.
    pub wavelength_metres: f64,
    /// Rise of the plane, per cent.
    pub slope_percent: f64,
    /// Direction in which the plane rises, degrees clockwise from grid north.
    pub slope_azimuth_degrees: f64,
}

impl Default for TerrainSpec {
    fn default() -> Self {
        Self {
            base_height_metres: 40.0,
            relief_metres: 6.0,
            wavelength_metres: 260.0,
            slope_percent: 2.0,
            slope_azimuth_degrees: 80.0,
        }
    }
}

/// A side of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// Low northings.
    South,
    /// High northings.
    North,
    /// Low eastings.
    West,
    /// High eastings.
    East,
}

/// `[water]`: a lake or the sea along one side, level, with a beach and docks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WaterSpec {
    /// Which side of the scene is water.
    pub side: Side,
    /// Share of the extent that is water, 0 to 0.9, measured along that axis.
    pub share: f64,
    /// Height of the water (NAVD88), metres; it must lie below the land.
    pub level_metres: f64,
    /// How far the shoreline swings about its mean, metres.
    pub shoreline_swing_metres: f64,
    /// Docks with boats, per 100 m of shore.
    pub docks_per_100_metres: f64,
}

impl Default for WaterSpec {
    fn default() -> Self {
        Self {
            side: Side::West,
            share: 0.2,
            level_metres: 5.0,
            shoreline_swing_metres: 8.0,
            docks_per_100_metres: 1.5,
        }
    }
}

/// `[streets]`: two families of parallel streets at right angles.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StreetSpec {
    /// Direction of the streets, degrees clockwise from grid north.
    pub azimuth_degrees: f64,
    /// Distance between the streets that run along the azimuth, metres.
    pub block_width_metres: f64,
    /// Distance between the streets that run across it, metres.
    pub block_length_metres: f64,
    /// By how much each distance varies, as a share, 0 to 0.4.
    pub irregularity: f64,
    /// Every how many streets one is an arterial road with four lanes; 0 for none.
    pub arterial_every: u32,
}

impl Default for StreetSpec {
    fn default() -> Self {
        Self {
            azimuth_degrees: 4.0,
            block_width_metres: 76.0,
            block_length_metres: 112.0,
            irregularity: 0.15,
            arterial_every: 3,
        }
    }
}

/// `[blocks]`: what the blocks are, as weights (their sum need not be 1), and how high they are built.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlockSpec {
    /// Weight of blocks of office towers and midrise houses, with plazas.
    pub downtown: f64,
    /// Weight of blocks of large flat-roofed shops with parking lots.
    pub commercial: f64,
    /// Weight of blocks of sheds, tanks and containers.
    pub industrial: f64,
    /// Weight of blocks of family houses with gardens.
    pub suburb: f64,
    /// Weight of parks with paths and sports courts.
    pub park: f64,
    /// Weight of blocks under closed forest.
    pub forest: f64,
    /// Share of the lots in a block that are built on, 0 to 1.
    pub built_share: f64,
    /// Height of the highest tower, metres.
    pub tower_height_metres: f64,
    /// Share of family houses whose roof is hipped rather than gabled, 0 to 1.
    pub hipped_share: f64,
}

impl Default for BlockSpec {
    fn default() -> Self {
        Self {
            downtown: 1.0,
            commercial: 1.0,
            industrial: 0.5,
            suburb: 4.0,
            park: 0.7,
            forest: 0.3,
            built_share: 0.95,
            tower_height_metres: 45.0,
            hipped_share: 0.4,
        }
    }
}

/// `[trees]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TreeSpec {
    /// Trees in a family garden, on average.
    pub per_garden: f64,
    /// Mean distance of street trees on each side of a street, metres; 0 for none.
    pub street_spacing_metres: f64,
    /// Trees per hectare of park.
    pub park_per_hectare: f64,
    /// Trees per hectare of forest.
    pub forest_per_hectare: f64,
    /// Share of conifers, 0 to 1; they keep their needles in winter.
    pub conifer_share: f64,
    /// Height of the highest tree, metres.
    pub height_metres: f64,
}

impl Default for TreeSpec {
    fn default() -> Self {
        Self {
            per_garden: 2.0,
            street_spacing_metres: 13.0,
            park_per_hectare: 70.0,
            forest_per_hectare: 230.0,
            conifer_share: 0.3,
            height_metres: 20.0,
        }
    }
}

/// `[cars]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CarSpec {
    /// Share of the places along the kerbs, in driveways and in parking lots that are taken, 0 to 1.
    pub parked_share: f64,
    /// Driving cars per 100 m of lane.
    pub driving_per_100_metres: f64,
}

impl Default for CarSpec {
    fn default() -> Self {
        Self { parked_share: 0.45, driving_per_100_metres: 0.8 }
    }
}

/// `[sun]`: a point source at infinity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SunSpec {
    /// Direction towards the sun, degrees clockwise from true north.
    pub azimuth_degrees: f64,
    /// Height of the sun over the horizon, degrees, above 0 and up to 90.
    pub elevation_degrees: f64,
}

/// `[view]`: a satellite far away, off nadir. Images stay registered to the bare earth, as
/// orthophotos made with a terrain model are: only what stands on it leans.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewSpec {
    /// Angle between the line of sight and the vertical, degrees, 0 to 45.
    pub off_nadir_degrees: f64,
    /// Direction from the scene to the satellite, degrees clockwise from true north; roofs lean the
    /// other way, by height x tan(angle).
    pub azimuth_degrees: f64,
}

/// A season, which decides about leaves and colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Season {
    /// Fresh green.
    Spring,
    /// Full leaves, dry lawns.
    #[default]
    Summer,
    /// Coloured leaves.
    Autumn,
    /// Broad-leaved trees are bare: lidar and light pass between their branches.
    Winter,
}

/// What a lidar cell's height is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// The surface at the cell's centre, exactly.
    #[default]
    Point,
    /// The mean of the surface at 4 x 4 points of the cell.
    Area,
}

/// `[lidar]`: the survey. All its flaws are off unless stated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LidarSpec {
    /// Standard deviation of the noise of heights, metres; normal, cut at 4 sigma.
    pub noise_sigma_metres: f64,
    /// Share of cells that no pulse hit (they are nodata in the surface model), 0 to 0.9.
    pub missing_pulse_share: f64,
    /// Share of crown cells where the pulse passed through to what lies below, 0 to 1.
    pub crown_penetration_share: f64,
    /// Gaps between flight lines, as strips of nodata across the scene.
    pub gap_count: u32,
    /// Width of a gap, metres.
    pub gap_width_metres: f64,
    /// What a cell's height is.
    pub sampling: Sampling,
    /// Year of the survey.
    pub year: i32,
    /// Season of the survey.
    pub season: Season,
}

impl Default for LidarSpec {
    fn default() -> Self {
        Self {
            noise_sigma_metres: 0.0,
            missing_pulse_share: 0.0,
            crown_penetration_share: 0.0,
            gap_count: 0,
            gap_width_metres: 4.0,
            sampling: Sampling::Point,
            year: 2021,
            season: Season::Summer,
        }
    }
}

/// Compression of the tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileCompression {
    /// None.
    None,
    /// Deflate with the floating-point predictor.
    #[default]
    Deflate,
}

/// How a tile's samples are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TileStorage {
    /// Strips of whole rows.
    Strips,
    /// Square blocks.
    #[default]
    Blocks,
}

/// `[tiles]`: GeoTIFF files in EPSG:2927, heights in US survey feet, 32-bit float.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TileSpec {
    /// Tiles from west to east.
    pub columns: u32,
    /// Tiles from south to north.
    pub rows: u32,
    /// Pixels that neighbours share.
    pub overlap_pixels: u32,
    /// Pixel size, US survey feet.
    pub pixel_feet: f64,
    /// Value of cells without height (over water, in gaps); `nan` is allowed.
    pub nodata: f64,
    /// Compression.
    pub compression: TileCompression,
    /// Strips or blocks.
    pub storage: TileStorage,
    /// Rows of a strip, or side of a square block (a multiple of 16), pixels.
    pub block_pixels: u32,
    /// Number of the first tile: `king_county_west_2021_dsm_87.tif`.
    pub first_number: u32,
    /// Whether the files say that their heights are US survey feet; real deliveries may not.
    pub state_vertical_unit: bool,
}

impl Default for TileSpec {
    fn default() -> Self {
        Self {
            columns: 2,
            rows: 2,
            overlap_pixels: 48,
            pixel_feet: 1.5,
            nodata: -9999.0,
            compression: TileCompression::Deflate,
            storage: TileStorage::Blocks,
            block_pixels: 128,
            first_number: 87,
            state_vertical_unit: true,
        }
    }
}

/// How pictures are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ImageColours {
    /// 8-bit RGB.
    #[default]
    Rgb,
    /// A palette of 256 colours, as VIGOR's files have.
    Palette,
}

/// `[images]`: satellite images on a grid (or at listed places), and panorama positions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImageSpec {
    /// Zoom of the Web-Mercator pixel plane.
    pub zoom: u8,
    /// Side of an image, pixels.
    pub size_pixels: u32,
    /// Distance of image centres, pixels; Seattle's are 362.5 apart.
    pub spacing_pixels: f64,
    /// Image centres as `[latitude, longitude]` in degrees, instead of a grid.
    pub centres_degrees: Vec<[f64; 2]>,
    /// At most this many images of the grid, from the south-west; 0 for all that fit.
    pub maximum: u32,
    /// Panorama positions per image, on average.
    pub panoramas_per_image: f64,
    /// RGB or palette.
    pub colours: ImageColours,
    /// Standard deviation of the sensor's noise, grey levels out of 255.
    pub sensor_noise_levels: f64,
    /// Year of the images.
    pub year: i32,
    /// Season of the images.
    pub season: Season,
}

impl Default for ImageSpec {
    fn default() -> Self {
        Self {
            zoom: 20,
            size_pixels: 640,
            spacing_pixels: 362.5,
            centres_degrees: Vec::new(),
            maximum: 0,
            panoramas_per_image: 1.2,
            colours: ImageColours::Rgb,
            sensor_noise_levels: 0.0,
            year: 2021,
            season: Season::Summer,
        }
    }
}

/// `[picture]`: one picture of the whole extent on a Web-Mercator grid around its centre, and the
/// heights that are true on it. It shows what the satellite images show: same year, season and sun.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PictureSpec {
    /// Zoom of the Web-Mercator pixel plane; 20, as the satellite images, if `pixel_metres` is absent too.
    pub zoom: Option<u8>,
    /// Pixel size on the ground at the centre, metres, in place of `zoom`.
    pub pixel_metres: Option<f64>,
    /// Size from west to east, metres; all that fits upright into the extent if absent.
    pub width_metres: Option<f64>,
    /// Size from south to north, metres; all that fits upright into the extent if absent.
    pub height_metres: Option<f64>,
    /// Distance of the points whose true height is written, pixels of the picture; 2.5 is the grid on which
    /// the network sees zoom 20.
    pub truth_spacing_pixels: f64,
}

impl Default for PictureSpec {
    fn default() -> Self {
        Self {
            zoom: None,
            pixel_metres: None,
            width_metres: None,
            height_metres: None,
            truth_spacing_pixels: 1.0,
        }
    }
}

/// `[change]`: what happens per year between the lidar and the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ChangeSpec {
    /// Share of the buildings that are new since the lidar, per year, 0 to 1.
    pub built_share_per_year: f64,
    /// Share of the buildings torn down since the lidar, per year, 0 to 1.
    pub demolished_share_per_year: f64,
    /// Share of the trees felled, per year, 0 to 1.
    pub felled_share_per_year: f64,
    /// Growth of the trees, metres of height per year (crowns grow in proportion).
    pub growth_metres_per_year: f64,
    /// Whether other cars are about; they are within any time that is not zero.
    pub cars_move: bool,
}

impl Default for ChangeSpec {
    fn default() -> Self {
        Self {
            built_share_per_year: 0.02,
            demolished_share_per_year: 0.02,
            felled_share_per_year: 0.02,
            growth_metres_per_year: 0.3,
            cars_move: true,
        }
    }
}

/// `[camera]`: what air, lens and processing make of the images. Heights do not hang on it; the picture
/// of `[picture]` is not blurred or sharpened.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraSpec {
    /// Light of the sky in shadows, as a factor: deep shadows below 1, 0.1 to 2.
    pub sky_light: f64,
    /// Share of the picture that is haze, 0 to 0.6.
    pub haze: f64,
    /// Brightness, as a factor of linear light, 0.2 to 4.
    pub exposure: f64,
    /// Factors of red, green and blue, 0.5 to 2.
    pub white_balance: [f64; 3],
    /// Colourfulness, as a factor; 0 is grey, at most 2.
    pub saturation: f64,
    /// Contrast of the display values about a middle grey, as a factor, 0.3 to 3.
    pub contrast: f64,
    /// Standard deviation of the blur, pixels, 0 to 5.
    pub blur_pixels: f64,
    /// Share of the fine detail that is added again, 0 to 2.
    pub sharpening: f64,
    /// Whether colours have half the resolution of brightness, as in JPEG files.
    pub half_colour_resolution: bool,
}

impl Default for CameraSpec {
    fn default() -> Self {
        Self {
            sky_light: 1.0,
            haze: 0.025,
            exposure: 1.0,
            white_balance: [1.0; 3],
            saturation: 1.0,
            contrast: 1.0,
            blur_pixels: 0.0,
            sharpening: 0.0,
            half_colour_resolution: false,
        }
    }
}

/// `[detail]`: more of what real cities have: varied roofs, courts, crowns of many lumps, and what the
/// keys say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DetailSpec {
    /// Weight of blocks of railway tracks among those of `[blocks]`.
    pub railway: f64,
    /// Share of the lots in suburbs with a block of flats, 0 to 1.
    pub flats_share: f64,
    /// Share of roofs, cars and walls that are black, grey or white, 0 to 1.
    pub grey_share: f64,
    /// How much larger garden and street trees are, as a share, 0 to 2.
    pub larger_trees: f64,
    /// Share of the forest whose crowns touch, 0 to 1.
    pub closed_canopy: f64,
    /// Share of the local streets with poles and wires, 0 to 1.
    pub wires_share: f64,
    /// Share of the gardens with fences, 0 to 1.
    pub fence_share: f64,
}
