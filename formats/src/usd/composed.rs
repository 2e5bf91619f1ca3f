//! Composes layers to a stage: which prims there are, and the strongest values of their properties.
//!
//! ```text
//!   shot.usda ── sublayers ──▶ water.usdc           one stack of layers, strongest first
//!      │  references, payloads
//!      └──▶ asset.usda</Asset> ──▶ ..               another stack, below a prim of the first
//! ```
//!
//! A prim has a site for each prim or variant of a stack that contributes to it, strongest first: its own,
//! those that it inherits, its selected variants, its references, its payloads, and those that it
//! specialises. Files are opened relative to the folder of the layer that names them, and must be within the
//! folder of the first one. Files of other formats, such as materials, are left out. Value clips and relocated prims
//! are refused.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeSet, HashSet};
use std::rc::Rc;
use std::slice;
use std::sync::Arc;

use super::FORMAT;
use super::layer::{Layer, LayerArc, ListEdits, TimeSamples, Value};
use super::package::{LayerBytes, Package};
use crate::core::container::{ContainerFile, OpenFurther, folder_of, further_path};
use crate::core::error::{Error, Result};
use crate::core::limits::Limits;
use crate::core::text::{excerpt, excerpts};

/// The layers of a file, and those to which it refers.
pub(crate) struct ComposedStage<'a> {
    open: &'a OpenFurther<'a>,
    limits: Limits,
    files: RefCell<Vec<Rc<LayerFile<'a>>>>,
    stacks: RefCell<Vec<Rc<LayerStack>>>,
    /// Files of other formats to which the layers refer.
    left_out: RefCell<BTreeSet<String>>,
    /// Whether to compare the layers of packages with their checksums, which reads all of their bytes.
    checks_sums: bool,
    /// How many sites were composed; a long path counts as several.
    work: Cell<usize>,
    /// The largest `work`: references multiply prims, but not without end.
    work_max: Cell<usize>,
}

/// A layer and where it was opened.
struct LayerFile<'a> {
    layer: Layer<'a>,
    /// Its path, relative to the folder of the first file or to the root of its package.
    path: String,
    package: Option<Rc<Package<'a>>>,
}

/// A layer with its sublayers, as indices into the files, strongest first, and the offset and scale of the
/// time of each.
type LayerStack = Vec<(usize, Retime)>;

/// The offset and scale that turn a time code of a layer into one of the stage.
type Retime = [f64; 2];

/// `outer` after `inner`.
fn combined(outer: Retime, inner: Retime) -> Retime {
    [outer[0] + outer[1] * inner[0], outer[1] * inner[1]]
}

/// The nodes of a stack that contribute to a prim.
#[derive(Clone)]
struct Site {
    stack: usize,
    /// For each, the index of its layer in the stack, and the node.
    nodes: Vec<(usize, usize)>,
    retime: Retime,
}

/// A node of a site.
struct SiteNode<'a> {
    file: Rc<LayerFile<'a>>,
    node: usize,
    /// From the time of its layer to that of its stack, and to that of the stage.
    of_layer: Retime,
    retime: Retime,
}

/// A prim of the stage.
pub(crate) struct StagePrim {
    pub(crate) path: String,
    pub(crate) parent: Option<Rc<StagePrim>>,
    sites: Vec<Site>,
}

/// A property in the layer with the strongest value.
pub(crate) struct StrongestValue<'a> {
    file: Rc<LayerFile<'a>>,
    /// The samples, and the time codes of the stage at which they are.
    pub(crate) samples: Option<(Arc<TimeSamples>, Vec<f64>)>,
    /// The value without samples.
    pub(crate) default: Option<Value>,
}

impl<'a> StrongestValue<'a> {
    pub(crate) fn layer(&self) -> &Layer<'a> {
        &self.file.layer
    }
}

/// The most sites of a stage beside some for each node of its layers, and the bytes of a path that count as one.
const SITES_MAX: usize = 1 << 17;
const SITES_PER_NODE: usize = 32;
const PATH_BYTES: usize = 128;
/// The deepest nesting of prims and of references, and the most layers.
const PRIM_DEPTH_MAX: usize = 64;
const ARC_DEPTH_MAX: usize = 16;
const FILES_MAX: usize = 4096;

impl<'a> ComposedStage<'a> {
    /// Reads the structure of a file and of its sublayers.
    ///
    /// # Errors
    /// Those of [`Layer::read`]; [`Error::Unsupported`] for a sublayer that cannot be opened.
    pub(crate) fn open(
        container: &ContainerFile<'a>,
        limits: &Limits,
        checks_sums: bool,
    ) -> Result<ComposedStage<'a>> {
        let file = LayerBytes::new(Rc::new(container.file))?;
        ComposedStage::of_file(file, container.open, limits, checks_sums)
    }

    /// The stage of a file, which `open` opens others beside.
    pub(crate) fn of_file(
        file: LayerBytes<'a>,
        open: &'a OpenFurther<'a>,
        limits: &Limits,
        checks_sums: bool,
    ) -> Result<ComposedStage<'a>> {
        let stage = ComposedStage {
            open,
            limits: *limits,
            files: RefCell::default(),
            stacks: RefCell::default(),
            left_out: RefCell::default(),
            checks_sums,
            work: Cell::new(0),
            work_max: Cell::new(SITES_MAX),
        };
        stage.add_file(file, String::new())?;
        stage.stack(0)?;
        Ok(stage)
    }

    /// The first layer.
    pub(crate) fn root_layer<T>(&self, read: impl FnOnce(&Layer) -> Result<T>) -> Result<T> {
        read(&self.file(0).layer)
    }

    /// The time codes of a second.
    pub(crate) fn codes_per_second(&self) -> Result<f64> {
        codes_per_second(&self.file(0).layer)
    }

    /// A note on the files to which the traversed prims refer and which are not read.
    pub(crate) fn left_out_note(&self) -> Option<String> {
        let names = self.left_out.borrow();
        (!names.is_empty()).then(|| format!("left out layers that are not USD: {}", excerpts(names.iter())))
    }

    /// Sets the counts of bytes and sites to 0.
    pub(crate) fn start_anew(&self) {
        self.work.set(0);
        self.files.borrow().iter().for_each(|file| file.layer.start_anew());
    }

    fn file(&self, index: usize) -> Rc<LayerFile<'a>> {
        Rc::clone(&self.files.borrow()[index])
    }

    /// Opens a layer, or the first layer of a package.
    fn add_file(&self, file: LayerBytes<'a>, path: String) -> Result<usize> {
        if file.head()? != *b"PK\x03\x04" {
            return self.add_layer(file, path, None);
        }
        let package = Package::read(&file)?;
        let Some((first, ..)) = package.files.first().cloned() else {
            return Err(Error::unsupported(FORMAT, "the package has no files"));
        };
        self.add_packed(Rc::new(package), &first, "the package")
    }

    /// Opens a file of a package. `place` is what refers to it.
    fn add_packed(&self, package: Rc<Package<'a>>, path: &str, place: &str) -> Result<usize> {
        let found = package.files.iter().find(|(name, ..)| name == path).cloned();
        let missing = || refused(place, path, "the package does not have it");
        let (_, bytes, checksum) = found.ok_or_else(missing)?;
        if self.checks_sums {
            bytes.check(checksum, path)?;
        }
        self.add_layer(bytes, path.to_owned(), Some(package)).map_err(|error| error.in_file(path))
    }

    fn add_layer(
        &self,
        file: LayerBytes<'a>,
        path: String,
        package: Option<Rc<Package<'a>>>,
    ) -> Result<usize> {
        let layer = Layer::read(file, &self.limits)?;
        let mut files = self.files.borrow_mut();
        if files.len() == FILES_MAX {
            return Err(Error::too_large(FORMAT, format!("the stage has more than {FILES_MAX} layers")));
        }
        self.work_max.set(self.work_max.get().saturating_add(SITES_PER_NODE * layer.nodes.len()));
        files.push(Rc::new(LayerFile { layer, path, package }));
        Ok(files.len() - 1)
    }

    /// The file with this path, in the folder or in the package of another one. `place` is what refers to it.
    fn further_file(&self, from: usize, path: &str, place: &str) -> Result<usize> {
        let from = self.file(from);
        let package = |file: &LayerFile| file.package.as_ref().map(Rc::as_ptr).map(<*const Package>::addr);
        let is_found = |file: &Rc<LayerFile>| file.path == path && package(file) == package(&from);
        if let Some(index) = self.files.borrow().iter().position(is_found) {
            return Ok(index);
        }
        if let Some(package) = &from.package {
            return self.add_packed(Rc::clone(package), path, place);
        }
        let file = (self.open)(path).map_err(|error| refused(place, path, &error.to_string()))?;
        let added = LayerBytes::new(file.into()).and_then(|bytes| self.add_file(bytes, path.to_owned()));
        added.map_err(|error| error.in_file(path))
    }

    /// The stack of layers that starts with this file.
    fn stack(&self, first: usize) -> Result<usize> {
        if let Some(found) = self.stacks.borrow().iter().position(|stack| stack[0].0 == first) {
            return Ok(found);
        }
        let mut layers = Vec::new();
        self.add_sublayers(first, [0.0, 1.0], &mut layers, 0)?;
        let mut stacks = self.stacks.borrow_mut();
        stacks.push(Rc::new(layers));
        Ok(stacks.len() - 1)
    }

    fn add_sublayers(
        &self,
        index: usize,
        retime: Retime,
        layers: &mut Vec<(usize, Retime)>,
        depth: usize,
    ) -> Result<()> {
        if depth > ARC_DEPTH_MAX || layers.iter().any(|(layer, _)| *layer == index) {
            let what =
                format!("the sublayers are nested more than {ARC_DEPTH_MAX} deep, or contain one another");
            return Err(Error::unsupported(FORMAT, what));
        }
        layers.push((index, retime));
        let file = self.file(index);
        for LayerArc { asset, retime: own, .. } in file.layer.sublayers()? {
            let Some(path) = self.beside(&file.path, &asset, "the stage")? else { continue };
            let further = self.further_file(index, &path, "the stage")?;
            let ratio = codes_per_second(&file.layer)? / codes_per_second(&self.file(further).layer)?;
            self.add_sublayers(further, combined(retime, [own[0], own[1] * ratio]), layers, depth + 1)?;
        }
        Ok(())
    }

    /// Visits all prims that are defined and active; `visit` says whether to go on below a prim.
    pub(crate) fn traverse(&self, visit: &mut dyn FnMut(&Rc<StagePrim>) -> Result<bool>) -> Result<()> {
        let root = StagePrim { path: String::new(), parent: None, sites: self.root(0) };
        self.traverse_below(&Rc::new(root), visit, 0)
    }

    fn traverse_below(
        &self,
        parent: &Rc<StagePrim>,
        visit: &mut dyn FnMut(&Rc<StagePrim>) -> Result<bool>,
        depth: usize,
    ) -> Result<()> {
        if depth > PRIM_DEPTH_MAX {
            let what = format!("{} is nested more than {PRIM_DEPTH_MAX} deep", excerpt(&parent.path));
            return Err(Error::too_large(FORMAT, what));
        }
        // Weaker layers come first in the order of prims, as in OpenUSD.
        let mut names: Vec<String> = Vec::new();
        let mut known = HashSet::new();
        for SiteNode { file, node, .. } in self.nodes(&parent.sites).into_iter().rev() {
            names.extend(file.layer.prim_names(node)?.into_iter().filter(|name| known.insert(name.clone())));
        }
        for name in names {
            let path = format!("{}/{name}", parent.path);
            let sites = self.child(&parent.sites, &name, &path, 0)?;
            let prim = Rc::new(StagePrim { path, parent: Some(Rc::clone(parent)), sites });
            if self.is_shown(&prim)? && visit(&prim)? {
                self.traverse_below(&prim, visit, depth + 1)?;
            }
        }
        Ok(())
    }

    /// Whether a prim is defined, not abstract, and active.
    fn is_shown(&self, prim: &StagePrim) -> Result<bool> {
        for refused in ["clips", "relocates"] {
            if self.prim_field(prim, refused)?.is_some() {
                let what = format!(
                    "the prim {} has {refused}, which are not supported: flatten the stage with usdcat --flatten",
                    excerpt(&prim.path)
                );
                return Err(Error::unsupported(FORMAT, what));
            }
        }
        if self.prim_field(prim, "active")?.and_then(|value| value.number()) == Some(0.0) {
            return Ok(false);
        }
        const OVER: f64 = 1.0;
        let specifier = self.strongest(prim, |SiteNode { file, node, .. }| {
            Ok(file.layer.number(node, "specifier")?.filter(|specifier| *specifier != OVER))
        })?;
        Ok(specifier == Some(0.0))
    }

    /// All nodes of sites, strongest first.
    fn nodes(&self, sites: &[Site]) -> Vec<SiteNode<'a>> {
        let mut all = Vec::new();
        for site in sites {
            let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
            all.extend(site.nodes.iter().map(|&(index, node)| {
                let (layer, of_layer) = stack[index];
                SiteNode { file: self.file(layer), node, of_layer, retime: combined(site.retime, of_layer) }
            }));
        }
        all
    }

    /// The first value that a function returns for the nodes of a prim.
    fn strongest<T>(
        &self,
        prim: &StagePrim,
        of: impl FnMut(SiteNode<'a>) -> Result<Option<T>>,
    ) -> Result<Option<T>> {
        self.nodes(&prim.sites).into_iter().map(of).find_map(Result::transpose).transpose()
    }

    /// The strongest value of a field of a prim.
    pub(crate) fn prim_field(&self, prim: &StagePrim, name: &str) -> Result<Option<Value>> {
        self.strongest(prim, |SiteNode { file, node, .. }| file.layer.field(node, name))
    }

    /// The type of a prim, such as `Points`; empty without one.
    pub(crate) fn type_name(&self, prim: &StagePrim) -> Result<String> {
        let found = self.strongest(prim, |SiteNode { file, node, .. }| {
            Ok(file.layer.word(node, "typeName")?.filter(|name| !name.is_empty()))
        })?;
        Ok(found.unwrap_or_default())
    }

    /// The names of the attributes of a prim.
    pub(crate) fn attribute_names(&self, prim: &StagePrim) -> Result<Vec<String>> {
        let mut names: Vec<String> = Vec::new();
        for SiteNode { file, node, .. } in self.nodes(&prim.sites) {
            let nodes = &file.layer.nodes;
            for child in
                nodes[node].order.iter().map(|child| &nodes[*child]).filter(|child| child.is_attribute)
            {
                self.limits.check_attributes(FORMAT, names.len(), "attributes of a prim")?;
                if !names.iter().any(|known| **known == *child.name) {
                    names.push(child.name.to_string());
                }
            }
        }
        Ok(names)
    }

    /// The strongest value of a field of an attribute.
    pub(crate) fn attribute_field(
        &self,
        prim: &StagePrim,
        attribute: &str,
        name: &str,
    ) -> Result<Option<Value>> {
        self.strongest(prim, |SiteNode { file, node, .. }| match file.layer.child(node, attribute) {
            Some(child) => file.layer.field(child, name),
            None => Ok(None),
        })
    }

    /// The strongest value of an attribute; `None` if it has none.
    pub(crate) fn attribute(&self, prim: &StagePrim, name: &str) -> Result<Option<StrongestValue<'a>>> {
        self.strongest(prim, |SiteNode { file, node, retime, .. }| {
            let Some(child) = file.layer.child(node, name) else { return Ok(None) };
            let samples = match file.layer.field(child, "timeSamples")? {
                Some(Value::Samples(samples)) if !samples.codes.is_empty() => {
                    let codes = samples.codes.iter().map(|code| retime[0] + retime[1] * code).collect();
                    Some((samples, codes))
                }
                _ => None,
            };
            let default = match file.layer.field(child, "spline")? {
                Some(_) => Some(Value::Unread("a spline")),
                None => file.layer.field(child, "default")?,
            };
            let is_there = samples.is_some() || default.is_some();
            Ok(is_there.then(|| StrongestValue { file, samples, default }))
        })
    }

    /// The time codes at which an attribute has samples.
    pub(crate) fn sample_codes(&self, prim: &StagePrim, name: &str) -> Result<Vec<f64>> {
        let samples = self.attribute(prim, name)?.and_then(|value| value.samples);
        Ok(samples.map(|(_, codes)| codes).unwrap_or_default())
    }

    /// The site of the root of a stack.
    fn root(&self, stack: usize) -> Vec<Site> {
        let count = self.stacks.borrow()[stack].len();
        vec![Site { stack, nodes: (0..count).map(|layer| (layer, 0)).collect(), retime: [0.0, 1.0] }]
    }

    /// The sites of a child.
    fn child(&self, sites: &[Site], name: &str, path: &str, depth: usize) -> Result<Vec<Site>> {
        let mut found = Vec::new();
        for site in sites {
            self.expand(self.child_site(site, name), &mut found, path, depth)?;
        }
        Ok(found)
    }

    fn child_site(&self, site: &Site, name: &str) -> Site {
        let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
        let child = |&(index, node): &(usize, usize)| {
            Some((index, self.file(stack[index].0).layer.child(node, name)?))
        };
        Site { nodes: site.nodes.iter().filter_map(child).collect(), ..*site }
    }

    /// Adds a site and what it brings in.
    fn expand(&self, site: Site, found: &mut Vec<Site>, path: &str, depth: usize) -> Result<()> {
        if site.nodes.is_empty() {
            return Ok(());
        }
        self.work.set(self.work.get() + 1 + path.len() / PATH_BYTES);
        if depth > ARC_DEPTH_MAX || self.work.get() > self.work_max.get() {
            let what = format!(
                "the references of {} are nested more than {ARC_DEPTH_MAX} deep or contain themselves, or the stage has \
                 too many prims",
                excerpt(path)
            );
            return Err(Error::too_large(FORMAT, what));
        }
        found.push(site.clone());
        for target in self.names(&site, "inheritPaths")? {
            self.follow(&site, &of_stack(target), found, path, depth)?;
        }
        let mut with_weaker: Option<Vec<Site>> = None;
        for set in self.names(&site, "variantSetNames")? {
            let mut selected = self.selection(found, &set)?;
            if selected.is_none() {
                // What the prim refers to is weaker than its variants, and can select one nevertheless.
                if with_weaker.is_none() {
                    let mut all = found.clone();
                    self.add_weaker(&site, &mut all, path, depth)?;
                    with_weaker = Some(all);
                }
                selected = self.selection(with_weaker.as_deref().unwrap_or_default(), &set)?;
            }
            if let Some(variant) = selected {
                self.expand(self.child_site(&site, &format!("{{{set}={variant}}}")), found, path, depth + 1)?;
            }
        }
        self.add_weaker(&site, found, path, depth)
    }

    /// Adds the sites that are weaker than the variants of a site.
    fn add_weaker(&self, site: &Site, found: &mut Vec<Site>, path: &str, depth: usize) -> Result<()> {
        for field in ["references", "payload"] {
            for arc in self.arcs(site, field, path)? {
                self.follow(site, &arc, found, path, depth)?;
            }
        }
        for target in self.names(site, "specializes")? {
            self.follow(site, &of_stack(target), found, path, depth)?;
        }
        Ok(())
    }

    /// Adds the sites of the prim to which an arc leads.
    fn follow(
        &self,
        site: &Site,
        arc: &LayerArc,
        found: &mut Vec<Site>,
        path: &str,
        depth: usize,
    ) -> Result<()> {
        let mut retime = combined(site.retime, arc.retime);
        let mut target = site.stack;
        if !arc.asset.is_empty() {
            let own = self.stacks.borrow()[site.stack][0].0;
            let further = self.further_file(own, &arc.asset, &excerpt(path))?;
            retime[1] *=
                codes_per_second(&self.file(own).layer)? / codes_per_second(&self.file(further).layer)?;
            target = self.stack(further)?;
        }
        let root = self.stacks.borrow()[target][0].0;
        let prim = match arc.prim.as_str() {
            "" => self.file(root).layer.word(0, "defaultPrim")?.unwrap_or_default(),
            prim => prim.to_owned(),
        };
        let first = found.len();
        let names: Vec<&str> = prim.split('/').filter(|name| !name.is_empty()).collect();
        if let Some((last, parents)) = names.split_last() {
            let mut sites = self.root(target);
            for name in parents {
                sites = self.child(&sites, name, path, depth + 1)?;
            }
            // The sites that were found before are stronger, and can select its variants.
            for site in &sites {
                self.expand(self.child_site(site, last), found, path, depth + 1)?;
            }
        }
        if found.len() == first {
            let what =
                format!("{} refers to the prim `{}`, which does not exist", excerpt(path), excerpt(&prim));
            return Err(Error::unsupported(FORMAT, what));
        }
        for site in &mut found[first..] {
            site.retime = combined(retime, site.retime);
        }
        Ok(())
    }

    /// The list of names in a field, with the edits of all layers.
    fn names(&self, site: &Site, field: &str) -> Result<Vec<String>> {
        let mut names = Vec::new();
        for SiteNode { file, node, .. } in self.nodes(slice::from_ref(site)).into_iter().rev() {
            names = match file.layer.field(node, field)? {
                Some(Value::WordEdits(edits)) => edits.apply(names),
                Some(value) => file.layer.words(&value)?,
                None => names,
            };
        }
        Ok(names)
    }

    /// The references or payloads, with the paths of files relative to the folder of the first one.
    fn arcs(&self, site: &Site, field: &str, path: &str) -> Result<Vec<LayerArc>> {
        let mut arcs = Vec::new();
        for SiteNode { file, node, of_layer, .. } in self.nodes(slice::from_ref(site)).into_iter().rev() {
            if let Some(Value::ArcEdits(edits)) = file.layer.field(node, field)? {
                let edits: ListEdits<LayerArc> = edits.filter_map(|arc| {
                    let asset = match arc.asset.as_str() {
                        "" => Some(String::new()),
                        asset => self.beside(&file.path, asset, &excerpt(path))?,
                    };
                    let retime = combined(of_layer, arc.retime);
                    Ok(asset.map(|asset| LayerArc { asset, prim: arc.prim.clone(), retime }))
                })?;
                arcs = edits.apply(arcs);
            }
        }
        Ok(arcs)
    }

    /// The path of a layer that the file `from` names; `None` for a file of another format.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if it is outside the folder of the first one, or within a package.
    fn beside(&self, from: &str, asset: &str, place: &str) -> Result<Option<String>> {
        let name = asset.rsplit(['/', '\\']).next().unwrap_or_default();
        // OpenUSD, too, decides by the extension.
        let extension = name.rsplit_once('.').map(|(_, extension)| extension.to_ascii_lowercase());
        if extension.is_some_and(|extension| !extension.starts_with("usd")) {
            self.left_out.borrow_mut().insert(asset.to_owned());
            return Ok(None);
        }
        let path = further_path(FORMAT, folder_of(from), asset).map_err(|error| error.in_file(place))?;
        // Brackets name a file within a package.
        if path.contains('[') {
            return Err(refused(place, asset, "it is within a package: unpack the package"));
        }
        Ok(Some(path))
    }

    /// The selected variant of a set.
    fn selection(&self, sites: &[Site], set: &str) -> Result<Option<String>> {
        for SiteNode { file, node, .. } in self.nodes(sites) {
            if let Some(Value::Dictionary(entries)) = file.layer.field(node, "variantSelection")?
                && let Some((_, Value::Word(variant))) = entries.into_iter().find(|(name, _)| name == set)
            {
                return Ok(Some(variant).filter(|variant| !variant.is_empty()));
            }
        }
        Ok(None)
    }
}

/// An arc to a prim of the same stack.
fn of_stack(prim: String) -> LayerArc {
    LayerArc { asset: String::new(), prim, retime: [0.0, 1.0] }
}

/// The time codes of a second in a layer.
fn codes_per_second(layer: &Layer) -> Result<f64> {
    let stated = match layer.number(0, "timeCodesPerSecond")? {
        Some(stated) => Some(stated),
        None => layer.number(0, "framesPerSecond")?,
    };
    Ok(stated.filter(|stated| stated.is_finite() && *stated > 0.0).unwrap_or(24.0))
}

fn refused(place: &str, asset: &str, why: &str) -> Error {
    Error::unsupported(FORMAT, format!("{place} refers to the layer {}: {why}", excerpt(asset)))
}
