use glam::DVec3;
#[derive(Clone, Debug)]
pub struct Region {
    pub center: DVec3,
    pub radius: f64,
    pub shape: RegionShape,
    pub how: String,
}
#[derive(Clone, Debug)]
pub enum RegionShape {
    Sphere,
    Box { half: DVec3 },
}
pub struct RegionOverrides;
