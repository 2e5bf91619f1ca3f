//! Groups columns into attributes and recognises what they mean.
//!
//! PLY and delimited text have only scalar columns: a velocity is three columns, and programs name them
//! differently. This module splits each name into a stem and a component, and joins the columns with the same
//! stem. Formats with vector attributes use only the recognition of roles.
//!
//! ```text
//!   "Points:0" "Points:1" "Points:2"       ->  the position
//!   vx vy vz   velocity_x ..   "Vel.x [m/s]" ..  U_0 ..   ->  an attribute of arity 3, Velocity
//!   red green blue Alpha                   ->  color, arity 4, Color
//!   width                                  ->  width, arity 1, Radius, to be halved
//!   f_rest_0 .. f_rest_44                  ->  f_rest, arity 45, no role
//!   temperature                            ->  temperature, arity 1, no role
//! ```
//!
//! The comparison of names ignores quotes, the prefix `scalar_` (CloudCompare), a unit in brackets, and case;
//! the attribute's name keeps the case of the file. Each role is assigned at most once: if two attributes
//! match, the one whose alias comes first in `ROLES` gets the role, and the other one gets no role.
//! The same applies to the position.

use std::collections::HashMap;

use crate::core::data::{AttributeRole, FileAttribute, Values};

/// The interpretation of a list of columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    /// The columns of the position's x, y and z, or `None`. They can have different types.
    pub position: Option<[usize; 3]>,
    /// All other columns, each in exactly one group; ordered by the first column of each group.
    pub groups: Vec<Group>,
}

/// The columns of one attribute. All have the same type.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// The columns' common stem, or the whole name (without quotes) of a single column.
    pub name: String,
    /// Its recognised meaning.
    pub role: Option<AttributeRole>,
    /// Indices into the list of columns, in component order; never empty.
    pub columns: Vec<usize>,
    /// Factor for the values: 0.5 for a diameter, which becomes a radius, else 1.
    pub scale: f64,
}

impl Group {
    /// Number of values per particle.
    pub fn arity(&self) -> usize {
        self.columns.len()
    }
}

/// Groups named columns into the position and attributes.
pub fn group_columns<T: PartialEq>(columns: &[(&str, T)]) -> Columns {
    let names: Vec<&str> = columns.iter().map(|(name, _)| matched_part(name)).collect();
    let families = Families::collect(&names);
    let position = families.position();
    let mut used = vec![false; columns.len()];
    for index in position.into_iter().flatten() {
        used[index] = true;
    }

    let mut groups = families.vectors(columns, &mut used);
    for (index, (name, _)) in columns.iter().enumerate() {
        if !used[index] {
            groups.push(Group { name: unquoted(name).into(), role: None, columns: vec![index], scale: 1.0 });
        }
    }
    groups.sort_by_key(|group| group.columns.iter().copied().min());

    let attributes: Vec<(&str, usize)> =
        groups.iter().map(|group| (group.name.as_str(), group.arity())).collect();
    let roles = roles_of(&attributes);
    for (group, role) in groups.iter_mut().zip(roles) {
        group.role = role;
        if role == Some(AttributeRole::Radius) {
            group.scale = radius_scale(&group.name);
        }
    }
    Columns { position, groups }
}

/// The role of an attribute with this name and arity.
pub fn role_of(name: &str, arity: usize) -> Option<AttributeRole> {
    ranked_role(name, arity).map(|(role, _)| role)
}

/// The roles of attributes, given as name and arity. Each role is assigned at most once.
pub fn roles_of(attributes: &[(&str, usize)]) -> Vec<Option<AttributeRole>> {
    let ranked: Vec<_> = attributes.iter().map(|&(name, arity)| ranked_role(name, arity)).collect();
    let mut roles = vec![None; attributes.len()];
    for &(role, _) in ROLES {
        let candidates = ranked.iter().enumerate().filter_map(|(index, found)| match found {
            Some((found, rank)) if *found == role => Some((*rank, index)),
            _ => None,
        });
        if let Some((_, index)) = candidates.min() {
            roles[index] = Some(role);
        }
    }
    roles
}

/// An attribute whose role was recognised by its name. Text keeps only the role of a phase: it cannot be a
/// velocity or another quantity. Diameters become radii.
pub fn with_role(name: String, arity: usize, role: Option<AttributeRole>, values: Values) -> FileAttribute {
    let is_text = matches!(values, Values::Strings { .. });
    let role = role.filter(|&role| !is_text || role == AttributeRole::Kind);
    let mut attribute = FileAttribute { name, arity, role, values };
    if role == Some(AttributeRole::Radius) {
        attribute.values.scale(radius_scale(&attribute.name));
    }
    attribute
}

/// The values of an attribute that a text contains only as integers, in the narrowest type that fits all. For
/// some roles they are reals that were printed without decimals.
pub(crate) fn of_integers(integers: Vec<i64>, role: Option<AttributeRole>) -> Values {
    let are_within = |low: i64, high: i64| integers.iter().all(|value| (low..=high).contains(value));
    let are_reals = match role {
        Some(
            AttributeRole::Velocity
            | AttributeRole::Acceleration
            | AttributeRole::Normal
            | AttributeRole::Radius
            | AttributeRole::Density
            | AttributeRole::Mass
            | AttributeRole::TextureCoordinates,
        ) => true,
        // A colour with only the values 0 and 1 probably has floats.
        Some(AttributeRole::Color) => are_within(0, 1),
        Some(AttributeRole::Id | AttributeRole::Kind) | None => false,
    };
    if are_reals {
        Values::F64(integers.into_iter().map(|value| value as f64).collect())
    } else if role == Some(AttributeRole::Color) && are_within(0, u8::MAX.into()) {
        Values::U8(integers.into_iter().filter_map(|value| u8::try_from(value).ok()).collect())
    } else if are_within(i32::MIN.into(), i32::MAX.into()) {
        Values::I32(integers.into_iter().filter_map(|value| i32::try_from(value).ok()).collect())
    } else {
        Values::I64(integers)
    }
}

/// The known names of attributes with this role, in lower case, best first.
pub fn aliases(role: AttributeRole) -> &'static [&'static str] {
    ROLES.iter().find(|(named, _)| *named == role).map_or(&[], |(_, aliases)| aliases)
}

/// The rank of a name among the names of a position, lower being better; `None` if it is not one of them. For
/// formats with vector attributes.
pub(crate) fn position_rank(name: &str) -> Option<usize> {
    let stem = matched_part(name).to_ascii_lowercase();
    // Without the empty stem: an array has a name. `x` and `r` are whole vectors here, not components; the last
    // ones are those of Genesis and Newton.
    let mut names = POSITIONS.iter().skip(1).chain(&["x", "xyz", "r", "particle_pos", "particle_q"]);
    names.position(|&alias| alias == stem)
}

/// The factor that turns values of an attribute with [`AttributeRole::Radius`] into radii.
pub fn radius_scale(name: &str) -> f64 {
    let name = matched_part(name).to_ascii_lowercase();
    if DIAMETERS.contains(&name.as_str()) { 0.5 } else { 1.0 }
}

/// The unit in brackets at the end of a name: `m/s` in `"Vel.x [m/s]"`.
pub fn unit_of(name: &str) -> Option<&str> {
    split_unit(unquoted(name)).1
}

/// A name without surrounding quotes and unit.
pub(crate) fn without_unit(name: &str) -> &str {
    split_unit(unquoted(name)).0
}

/// Whether two names differ at most in case, quotes, units and a prefix of CloudCompare.
pub(crate) fn is_same_name(one: &str, other: &str) -> bool {
    matched_part(one).eq_ignore_ascii_case(matched_part(other))
}

/// A name without surrounding quotes and spaces.
pub fn unquoted(name: &str) -> &str {
    let name = name.trim();
    for quote in ['"', '\''] {
        if let Some(inner) = name.strip_prefix(quote).and_then(|rest| rest.strip_suffix(quote)) {
            return inner.trim();
        }
    }
    name
}

/// The role and the rank of the alias, lower being better.
fn ranked_role(name: &str, arity: usize) -> Option<(AttributeRole, usize)> {
    let stem = matched_part(name);
    if stem == "U" && arity == 3 {
        return Some((AttributeRole::Velocity, usize::MAX)); // OpenFOAM's; a small u is more often a displacement
    }
    let stem = stem.to_ascii_lowercase();
    ROLES.iter().find_map(|&(role, aliases)| {
        let arity_fits = match role {
            AttributeRole::Velocity | AttributeRole::Acceleration | AttributeRole::Normal => arity == 3,
            AttributeRole::Color => arity == 3 || arity == 4,
            AttributeRole::Radius
            | AttributeRole::Density
            | AttributeRole::Mass
            | AttributeRole::Id
            | AttributeRole::Kind => arity == 1,
            AttributeRole::TextureCoordinates => arity == 2 || arity == 3,
        };
        let rank = aliases.iter().position(|&alias| alias == stem)?;
        arity_fits.then_some((role, rank))
    })
}

/// CloudCompare's prefix of scalar fields.
const PREFIX: &str = "scalar_";

/// The part of a name that is compared with the aliases.
fn matched_part(name: &str) -> &str {
    let (name, _) = split_unit(unquoted(name));
    match name.split_at_checked(PREFIX.len()) {
        Some((prefix, rest)) if prefix.eq_ignore_ascii_case(PREFIX) && !rest.is_empty() => rest,
        _ => name,
    }
}

/// Splits ` [unit]` or ` (unit)` off the end. An index such as `[0]` is not a unit.
fn split_unit(name: &str) -> (&str, Option<&str>) {
    for (open, close) in [('[', ']'), ('(', ')')] {
        let Some(inside) = name.strip_suffix(close) else { continue };
        let mut depth = 1;
        let opening = inside.char_indices().rev().find(|(_, char)| {
            depth += i32::from(*char == close) - i32::from(*char == open);
            depth == 0
        });
        let Some((front, unit)) = opening.map(|(at, _)| (&inside[..at], &inside[at + 1..])) else { continue };
        let is_index = !unit.is_empty() && unit.bytes().all(|byte| byte.is_ascii_digit());
        if !is_index && !front.trim().is_empty() {
            return (front.trim_end(), Some(unit.trim()));
        }
    }
    (name, None)
}

/// How a component is appended to the stem. All columns of an attribute use the same spelling.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Spelling {
    /// `vx`
    Bare,
    /// `v_x`, `v.x`: the separator.
    Letter(char),
    /// `Cd_r`: the separator.
    ColorLetter(char),
    /// `v_0`, `v:0`, and `v[0]` with the bracket as separator.
    Digit(char),
    /// `COORD1`: for positions only, as `p1` is more often the first pressure.
    BareDigit,
    /// `x-coordinate`, `Particle X-Coordinate`: the component comes first.
    Axis,
    /// Names without a common stem, such as red, green, blue: index into `WORDS`.
    Word(usize),
}

/// Splits `velocity_x` into the stem, the spelling and the component index.
fn split_component(name: &str) -> Option<(&str, Spelling, usize)> {
    for (word_index, (_, words)) in WORDS.iter().enumerate() {
        if let Some(component) = words.iter().position(|word| word.eq_ignore_ascii_case(name)) {
            return Some(("", Spelling::Word(word_index), component));
        }
    }
    if let Some((stem, index)) = name.strip_suffix(']').and_then(|inside| inside.rsplit_once('[')) {
        return Some((stem, Spelling::Digit('['), component_index(index)?));
    }
    if let Some((axis, stem)) = name.rsplit_once('-')
        && stem.eq_ignore_ascii_case("coordinate")
        && let Some(index) = letter_index("xyz", axis.rsplit(' ').next()?)
    {
        return Some((stem, Spelling::Axis, index));
    }
    if let Some((at, separator)) = name.char_indices().rev().find(|(_, c)| ['_', '.', ':', ' '].contains(c)) {
        let (stem, component) = (&name[..at], &name[at + 1..]);
        if let Some(index) = component_index(component) {
            return Some((stem, Spelling::Digit(separator), index));
        }
        if let Some(index) = letter_index("xyzw", component) {
            return Some((stem, Spelling::Letter(separator), index));
        }
        if let Some(index) = letter_index("rgba", component) {
            return Some((stem, Spelling::ColorLetter(separator), index));
        }
    }
    let (at, _) = name.char_indices().next_back()?;
    let (stem, component) = name.split_at(at);
    if ["coord", "coords", "pos"].iter().any(|numbered| stem.eq_ignore_ascii_case(numbered))
        && let Some(index) = component_index(component)
    {
        return Some((stem, Spelling::BareDigit, index));
    }
    Some((stem, Spelling::Bare, letter_index("xyz", component)?))
}

fn component_index(digits: &str) -> Option<usize> {
    let canonical = !digits.is_empty()
        && digits.len() <= 4
        && digits.bytes().all(|byte| byte.is_ascii_digit())
        && (digits == "0" || !digits.starts_with('0'));
    if canonical { digits.parse().ok() } else { None }
}

fn letter_index(letters: &str, component: &str) -> Option<usize> {
    letters.find(component.to_ascii_lowercase().as_str()).filter(|_| component.len() == 1)
}

/// A stem in one spelling, with the columns of its components.
struct Family<'a> {
    stem: &'a str,
    spelling: Spelling,
    /// Each component with its column, in order; of several columns of one component, the first.
    components: Vec<(usize, usize)>,
}

impl Family<'_> {
    /// The columns of components 0, 1, 2 and so on, up to the first missing one. Three or more numbered
    /// components may start at 1, as in MATLAB: `pos_1`, but not `p_1`, which is a pressure.
    fn contiguous(&self) -> Vec<usize> {
        let is_named =
            self.stem.len() > 1 && matches!(self.spelling, Spelling::Digit(_) | Spelling::BareDigit);
        let first = usize::from(is_named && self.components.len() > 2 && self.components[0].0 == 1);
        let consecutive =
            self.components.iter().zip(first..).take_while(|((found, _), expected)| found == expected);
        let columns: Vec<usize> = consecutive.map(|(&(_, column), _)| column).collect();
        if first == 1 && columns.len() < 3 { Vec::new() } else { columns }
    }

    fn arity_min(&self) -> usize {
        match self.spelling {
            Spelling::Letter(_) | Spelling::Digit(_) => 2,
            Spelling::Bare
            | Spelling::BareDigit
            | Spelling::Axis
            | Spelling::ColorLetter(_)
            | Spelling::Word(_) => 3,
        }
    }
}

/// All families in a list of columns, in order of appearance.
struct Families<'a> {
    list: Vec<Family<'a>>,
}

impl<'a> Families<'a> {
    fn collect(names: &[&'a str]) -> Families<'a> {
        let mut list: Vec<Family<'a>> = Vec::new();
        let mut index_of: HashMap<(String, Spelling), usize> = HashMap::new();
        for (column, name) in names.iter().enumerate() {
            let Some((stem, spelling, component)) = split_component(name) else { continue };
            let index = *index_of.entry((stem.to_ascii_lowercase(), spelling)).or_insert_with(|| {
                list.push(Family { stem, spelling, components: Vec::new() });
                list.len() - 1
            });
            list[index].components.push((component, column));
        }
        for Family { components, .. } in &mut list {
            components.sort_unstable();
            components.dedup_by_key(|(component, _)| *component);
        }
        Families { list }
    }

    /// The columns of the position: of all families with a name for positions, the one with the best name.
    fn position(&self) -> Option<[usize; 3]> {
        let mut best: Option<(usize, [usize; 3])> = None;
        for family in &self.list {
            let stem = match family.spelling {
                Spelling::Word(word_index) => WORDS[word_index].0,
                Spelling::ColorLetter(_) => continue,
                // The centre of a grain or a cell.
                Spelling::Bare if family.stem.eq_ignore_ascii_case("c") => "center",
                _ => family.stem,
            };
            let stem = stem.to_ascii_lowercase();
            let Some(rank) = POSITIONS.iter().position(|&alias| alias == stem) else { continue };
            if let [x, y, z, ..] = family.contiguous()[..]
                && best.is_none_or(|(best_rank, _)| rank < best_rank)
            {
                best = Some((rank, [x, y, z]));
            }
        }
        best.map(|(_, position)| position)
    }

    /// The groups with more than one column; marks their columns as taken.
    fn vectors<T: PartialEq>(&self, columns: &[(&str, T)], used: &mut [bool]) -> Vec<Group> {
        let mut groups = Vec::new();
        for family in &self.list {
            let members = family.contiguous();
            let same_type = members.windows(2).all(|pair| columns[pair[0]].1 == columns[pair[1]].1);
            if members.len() < family.arity_min() || !same_type || members.iter().any(|&column| used[column])
            {
                continue;
            }
            for &column in &members {
                used[column] = true;
            }
            let name = match family.spelling {
                Spelling::Word(word_index) => WORDS[word_index].0,
                _ => family.stem,
            };
            groups.push(Group { name: name.into(), role: None, columns: members, scale: 1.0 });
        }
        groups
    }
}

/// Stems of the position, best first. The empty stem means plain `x y z`.
const POSITIONS: &[&str] = &[
    "",
    "position",
    "positions",
    "pos",
    "points",
    "point",
    "coordinates",
    "coordinate",
    "coords",
    "coord",
    "location",
    "p",
    "centroid",
    "center",
    "centre",
    "unwrapped",
];

/// The name of the resulting attribute, and the component names of a family without a common stem.
const WORDS: &[(&str, &[&str])] = &[
    ("color", &["red", "green", "blue", "alpha"]),
    ("color", &["r", "g", "b", "a"]),
    ("color", &["diffuse_red", "diffuse_green", "diffuse_blue", "diffuse_alpha"]),
    ("unwrapped", &["xu", "yu", "zu"]), // LAMMPS: not folded back into the periodic box
];

/// Names of each role in lower case, best first.
const ROLES: &[(AttributeRole, &[&str])] = &[
    (AttributeRole::Velocity, &["velocity", "velocities", "vel", "v", "particle_vel", "particle_qd"]),
    (AttributeRole::Acceleration, &["acceleration", "accelerations", "accel"]),
    (AttributeRole::Normal, &["normal", "normals", "n"]),
    (AttributeRole::Color, &["color", "colour", "colors", "colours", "cd", "rgb", "rgba", "displaycolor"]),
    (
        AttributeRole::Radius,
        &[
            "radius",
            "radii",
            "particle_radius",
            "particleradius",
            "pscale",
            "r",
            "diameter",
            "particle_diameter",
            "diam",
            "width",
            "widths",
        ],
    ),
    (AttributeRole::Density, &["density", "densities", "rho", "rhop"]),
    (AttributeRole::Mass, &["mass", "masses"]),
    (
        AttributeRole::Id,
        &["id", "ids", "idp", "particle_id", "particleid", "particleids", "particle identifier", "index"],
    ),
    (
        AttributeRole::Kind,
        &[
            "type",
            "phase",
            "species",
            "mk",
            "material",
            "object",
            "kind",
            "group",
            "piece",
            "particle_type",
            "material_id",
            "mat_id",
            "matid",
            "object_id",
            "body_id",
            "ptype",
            "is_boundary",
            "is_fluid",
            "is_wall",
            "particletype",
            "isboundary",
            "isfluid",
            "iswall",
            "boundary",
            "region",
            "body",
            "vtkghosttype",
        ],
    ),
    (AttributeRole::TextureCoordinates, &["uv", "st", "uvmap", "texcoord"]),
];

/// Aliases of the radius whose values are diameters.
const DIAMETERS: &[&str] = &["diameter", "particle_diameter", "diam", "width", "widths"];

#[cfg(test)]
mod tests {
    use super::*;

    /// Describes the position, then each attribute after a ` | `: `name columns role scale`.
    fn described(header: &str) -> String {
        let columns: Vec<(&str, &str)> = header.split(',').map(|name| (name, "float")).collect();
        describe(&group_columns(&columns))
    }

    fn describe(columns: &Columns) -> String {
        let mut text = format!("{:?}", columns.position.map(Vec::from).unwrap_or_default());
        for group in &columns.groups {
            text += &format!(" | {} {:?}", group.name, group.columns);
            if let Some(role) = group.role {
                text += &format!(" {role:?}");
            }
            if group.scale != 1.0 {
                text += &format!(" *{}", group.scale);
            }
        }
        text
    }

    #[test]
    fn headers_of_known_programs_are_grouped() {
        let table = [
            ("x,y,z", "[0, 1, 2]"),
            ("z,y,x", "[2, 1, 0]"),
            ("X,Y,Z", "[0, 1, 2]"),
            ("px,py,pz", "[0, 1, 2]"),
            ("Px,Py,Pz", "[0, 1, 2]"),
            ("pos_x,pos_y,pos_z", "[0, 1, 2]"),
            ("P[0],P[1],P[2]", "[0, 1, 2]"),
            ("position_x,position_y,position_z", "[0, 1, 2]"),
            ("Points_0,Points_1,Points_2", "[0, 1, 2]"),
            ("Position X (m),Position Y (m),Position Z (m)", "[0, 1, 2]"),
            ("xu,yu,zu", "[0, 1, 2]"),
            // An incomplete family of positions is not a position.
            ("x,y", "[] | x [0] | y [1]"),
            // Taichi.
            (
                "x,y,z,vx,vy,vz,red,green,blue,Alpha,pscale,id",
                "[0, 1, 2] | v [3, 4, 5] Velocity | color [6, 7, 8, 9] Color | pscale [10] Radius | id [11] Id",
            ),
            // Blender.
            (
                "x,y,z,id,radius,velocity_x,velocity_y,velocity_z,s,t",
                "[0, 1, 2] | id [3] Id | radius [4] Radius | velocity [5, 6, 7] Velocity | s [8] | t [9]",
            ),
            // VTK and ParaView.
            (
                r#""velocity:0","velocity:1","velocity:2","radius","id","Points:0","Points:1","Points:2""#,
                "[5, 6, 7] | velocity [0, 1, 2] Velocity | radius [3] Radius | id [4] Id",
            ),
            // DualSPHysics.
            (
                "Pos.x [m],Pos.y [m],Pos.z [m],Idp,Vel.x [m/s],Vel.y [m/s],Vel.z [m/s],Rhop [kg/m^3],Mk",
                "[0, 1, 2] | Idp [3] Id | Vel [4, 5, 6] Velocity | Rhop [kg/m^3] [7] Density | Mk [8] Kind",
            ),
            // OpenFOAM.
            ("x,y,z,U_0,U_1,U_2,p", "[0, 1, 2] | U [3, 4, 5] Velocity | p [6]"),
            ("x,y,z,u_0,u_1,u_2", "[0, 1, 2] | u [3, 4, 5]"),
            // LAMMPS.
            (
                "id,type,x,y,z,vx,vy,vz,fx,fy,fz,diameter",
                "[2, 3, 4] | id [0] Id | type [1] Kind | v [5, 6, 7] Velocity | f [8, 9, 10] | diameter [11] Radius *0.5",
            ),
            // CloudCompare.
            (
                "x,y,z,scalar_velocity_x,scalar_velocity_y,scalar_velocity_z,scalar_Density,nx,ny,nz",
                "[0, 1, 2] | velocity [3, 4, 5] Velocity | scalar_Density [6] Density | n [7, 8, 9] Normal",
            ),
            (
                "x,y,z,accel_x,accel_y,accel_z,Acceleration:0,Acceleration:1,Acceleration:2",
                "[0, 1, 2] | accel [3, 4, 5] | Acceleration [6, 7, 8] Acceleration",
            ),
            // MATLAB.
            ("pos_1,pos_2,pos_3,vel_1,vel_2,vel_3", "[0, 1, 2] | vel [3, 4, 5] Velocity"),
            ("p_1,p_2,p_3", "[] | p_1 [0] | p_2 [1] | p_3 [2]"),
            // Blender.
            ("id,location_x,location_y,location_z", "[1, 2, 3] | id [0] Id"),
            // Fluent, Rocky, Abaqus and OVITO.
            ("nodenumber,    x-coordinate,    y-coordinate,    z-coordinate", "[1, 2, 3] | nodenumber [0]"),
            (
                "ID,Particle X-Coordinate [m],Particle Y-Coordinate [m],Particle Z-Coordinate [m],Mass",
                "[1, 2, 3] | ID [0] Id | Mass [4] Mass",
            ),
            ("Node Label,COORD1,COORD2,COORD3,S", "[1, 2, 3] | Node Label [0] | S [4]"),
            (
                r#""Particle Identifier","Position.X","Position.Y","Position.Z""#,
                "[1, 2, 3] | Particle Identifier [0] Id",
            ),
            // Centres of grains and cells.
            ("id,cx,cy,cz,d", "[1, 2, 3] | id [0] Id | d [4]"),
            ("x,y,z,cx,cy,cz", "[0, 1, 2] | c [3, 4, 5]"),
            ("centroid_x,centroid_y,centroid_z,volume", "[0, 1, 2] | volume [3]"),
            // Pressures at gauges.
            ("t,p1,p2,p3", "[] | t [0] | p1 [1] | p2 [2] | p3 [3]"),
            // Research codes.
            ("ID,X,Y,Z,VX,VY,VZ", "[1, 2, 3] | ID [0] Id | V [4, 5, 6] Velocity"),
            ("x,y,z,velx,vely,velz", "[0, 1, 2] | vel [3, 4, 5] Velocity"),
        ];
        for (header, expected) in table {
            assert_eq!(described(header), expected, "of {header}");
        }
    }

    #[test]
    fn each_role_is_assigned_once() {
        let table = [
            ("x,y,z,pscale,radius", "[0, 1, 2] | pscale [3] | radius [4] Radius"),
            ("x,y,z,width,diameter", "[0, 1, 2] | width [3] | diameter [4] Radius *0.5"),
            ("x,y,z,rho,density", "[0, 1, 2] | rho [3] | density [4] Density"),
            ("px,py,pz,x,y,z", "[3, 4, 5] | p [0, 1, 2]"),
            ("x,y,z,r", "[0, 1, 2] | r [3] Radius"),
            ("x,y,z,r,g,b", "[0, 1, 2] | color [3, 4, 5] Color"),
            ("x,y,z,r,g,b,a", "[0, 1, 2] | color [3, 4, 5, 6] Color"),
            ("x,y,z,r,g", "[0, 1, 2] | r [3] Radius | g [4]"),
            ("x,y,z,red,green", "[0, 1, 2] | red [3] | green [4]"),
            ("x,y,z,alpha", "[0, 1, 2] | alpha [3]"),
        ];
        for (header, expected) in table {
            assert_eq!(described(header), expected, "of {header}");
        }
    }

    #[test]
    fn incomplete_families_stay_scalars() {
        let table = [
            ("x,y,z,vx,vy", "[0, 1, 2] | vx [3] | vy [4]"),
            ("x,y,z,a_1,a_2", "[0, 1, 2] | a_1 [3] | a_2 [4]"),
            ("x,y,z,a_0,a_1,a_3", "[0, 1, 2] | a [3, 4] | a_3 [5]"),
            ("x,y,z,x", "[0, 1, 2] | x [3]"),
            ("x,y,z,w", "[0, 1, 2] | w [3]"),
            ("x,y,z,v_x,v:1,v.z", "[0, 1, 2] | v_x [3] | v:1 [4] | v.z [5]"),
            ("x,y,z,life_0,life_1", "[0, 1, 2] | life [3, 4]"),
            ("pos_x,pos_y,pos_z,pos_w", "[0, 1, 2] | pos_w [3]"),
            ("x,y,z,a_00,a_01", "[0, 1, 2] | a_00 [3] | a_01 [4]"),
            ("", "[] |  [0]"),
            (
                "x,y,z,é,éx,_,[,],_x,[0]",
                "[0, 1, 2] | é [3] | éx [4] | _ [5] | [ [6] | ] [7] | _x [8] | [0] [9]",
            ),
        ];
        for (header, expected) in table {
            assert_eq!(described(header), expected, "of {header}");
        }
    }

    #[test]
    fn columns_of_mixed_types_form_a_position_but_no_vector() {
        let columns = [
            ("x", "float"),
            ("y", "double"),
            ("z", "float"),
            ("vx", "float"),
            ("vy", "double"),
            ("vz", "float"),
        ];
        assert_eq!(describe(&group_columns(&columns)), "[0, 1, 2] | vx [3] | vy [4] | vz [5]");
    }

    #[test]
    fn gaussian_splat_columns_are_grouped() {
        let mut header = String::from("x,y,z,nx,ny,nz,f_dc_0,f_dc_1,f_dc_2");
        for index in 0..45 {
            header += &format!(",f_rest_{index}");
        }
        header += ",opacity,scale_0,scale_1,scale_2,rot_0,rot_1,rot_2,rot_3";
        let columns: Vec<(&str, &str)> = header.split(',').map(|name| (name, "float")).collect();
        let groups = group_columns(&columns).groups;
        let arities: Vec<(&str, usize)> = groups.iter().map(|g| (g.name.as_str(), g.arity())).collect();
        assert_eq!(
            arities,
            [("n", 3), ("f_dc", 3), ("f_rest", 45), ("opacity", 1), ("scale", 3), ("rot", 4)]
        );
    }

    #[test]
    fn names_and_arities_give_roles() {
        let table = [
            ("v", 3, Some(AttributeRole::Velocity)),
            ("velocity", 3, Some(AttributeRole::Velocity)),
            ("Velocity", 3, Some(AttributeRole::Velocity)),
            ("U", 3, Some(AttributeRole::Velocity)),
            ("u", 3, None),
            ("velocity", 1, None),
            ("accel", 3, Some(AttributeRole::Acceleration)),
            ("Accelerations", 3, Some(AttributeRole::Acceleration)),
            ("accel", 1, None),
            ("Cd", 3, Some(AttributeRole::Color)),
            ("Cd", 4, Some(AttributeRole::Color)),
            ("N", 3, Some(AttributeRole::Normal)),
            ("pscale", 1, Some(AttributeRole::Radius)),
            ("pscale", 3, None),
            ("radius", 1, Some(AttributeRole::Radius)),
            ("width", 1, Some(AttributeRole::Radius)),
            ("density", 1, Some(AttributeRole::Density)),
            ("mass", 1, Some(AttributeRole::Mass)),
            ("id", 1, Some(AttributeRole::Id)),
            ("type", 1, Some(AttributeRole::Kind)),
            ("temperature", 1, None),
            ("", 1, None),
        ];
        for (name, arity, role) in table {
            assert_eq!(role_of(name, arity), role, "of {name}, arity {arity}");
        }
        assert_eq!(roles_of(&[("v", 3), ("velocity", 3)]), [None, Some(AttributeRole::Velocity)]);
        assert_eq!(radius_scale("Diameter"), 0.5);
        assert_eq!(radius_scale("pscale"), 1.0);
    }

    #[test]
    fn units_are_distinguished_from_indices() {
        let table = [
            ("Vel.x [m/s]", Some("m/s")),
            ("\"Rhop [kg/m^3]\"", Some("kg/m^3")),
            ("Position X (mm)", Some("mm")),
            ("radius[m]", Some("m")),
            ("v[0]", None),
            ("[m]", None),
            ("x", None),
        ];
        for (name, unit) in table {
            assert_eq!(unit_of(name), unit, "of {name}");
        }
    }
}
