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
//! folder of the first one. Value clips and relocated prims are refused.

use std::cell::{Cell, RefCell};
use std::collections::HashSet;
use std::rc::Rc;
use std::sync::Arc;

use super::FORMAT;
use super::layer::{Layer, LayerArc, LayerNode, ListEdits, TimeSamples, Value};
use super::package::{LayerBytes, Package};
use crate::container::{ContainerFile, OpenFurther};
use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::text::excerpt;

/// The layers of a file, and those to which it refers.
pub(crate) struct ComposedStage<'a> {
    open: &'a OpenFurther<'a>,
    limits: Limits,
    files: RefCell<Vec<Rc<LayerFile<'a>>>>,
    stacks: RefCell<Vec<Rc<LayerStack>>>,
    /// How many sites were composed.
    work: Cell<usize>,
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
struct LayerStack {
    layers: Vec<(usize, Retime)>,
}

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

/// The most sites of a stage, and the deepest nesting of prims and of references.
const SITES_MAX: usize = 1 << 20;
const PRIM_DEPTH_MAX: usize = 64;
const ARC_DEPTH_MAX: usize = 16;
const FILES_MAX: usize = 4096;

impl<'a> ComposedStage<'a> {
    /// Reads the structure of a file and of its sublayers.
    ///
    /// # Errors
    /// Those of [`Layer::read`]; [`Error::Unsupported`] for a sublayer that cannot be opened.
    pub(crate) fn open(container: &ContainerFile<'a>, limits: &Limits) -> Result<ComposedStage<'a>> {
        ComposedStage::of_file(LayerBytes::first(container.file)?, container.open, limits)
    }

    /// The stage of a file, which `open` opens others beside.
    pub(crate) fn of_file(
        file: LayerBytes<'a>,
        open: &'a OpenFurther<'a>,
        limits: &Limits,
    ) -> Result<ComposedStage<'a>> {
        let stage = ComposedStage {
            open,
            limits: *limits,
            files: RefCell::default(),
            stacks: RefCell::default(),
            work: Cell::new(0),
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
        let Some((first, bytes)) = package.files.first().cloned() else {
            return Err(Error::unsupported(FORMAT, "the package has no files"));
        };
        self.add_layer(bytes, first, Some(Rc::new(package)))
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
        files.push(Rc::new(LayerFile { layer, path, package }));
        Ok(files.len() - 1)
    }

    /// The file to which a layer refers by a path. `place` is the prim that refers to it.
    fn further_file(&self, from: usize, asset: &str, place: &str) -> Result<usize> {
        let from = self.file(from);
        let refused = |why: String| {
            Error::unsupported(FORMAT, format!("{place} refers to the layer {}: {why}", excerpt(asset)))
        };
        let path = beside(&from.path, asset)
            .ok_or_else(|| refused("it is outside the folder of the file".into()))?;
        let found = |file: &LayerFile| {
            let same = match (&file.package, &from.package) {
                (Some(a), Some(b)) => Rc::ptr_eq(a, b),
                (None, None) => true,
                _ => false,
            };
            same && file.path == path
        };
        if let Some(index) = self.files.borrow().iter().position(|file| found(file)) {
            return Ok(index);
        }
        if let Some(package) = &from.package {
            let range = package.file(&path).ok_or_else(|| refused("the package does not have it".into()))?;
            return self.add_layer(range, path, Some(Rc::clone(package)));
        }
        let file = (self.open)(&path).map_err(|error| refused(error.to_string()))?;
        self.add_file(LayerBytes::further(file)?, path)
    }

    /// The stack of layers that starts with this file.
    fn stack(&self, first: usize) -> Result<usize> {
        if let Some(found) = self.stacks.borrow().iter().position(|stack| stack.layers[0].0 == first) {
            return Ok(found);
        }
        let mut layers = Vec::new();
        self.add_sublayers(first, [0.0, 1.0], &mut layers, 0)?;
        let mut stacks = self.stacks.borrow_mut();
        stacks.push(Rc::new(LayerStack { layers }));
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
            let further = self.further_file(index, &asset, "the stage")?;
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
        self.for_nodes(parent, true, |file, node, _| {
            let more = file.layer.prim_names(node)?;
            let known: HashSet<&String> = names.iter().collect();
            let new: Vec<String> = more.into_iter().filter(|name| !known.contains(name)).collect();
            names.extend(new);
            Ok(None::<()>)
        })?;
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
        let specifier = self.for_nodes(prim, false, |file, node, _| {
            Ok(file.layer.number(node, "specifier")?.filter(|specifier| *specifier != OVER))
        })?;
        Ok(specifier == Some(0.0))
    }

    /// Calls a function for all nodes of a prim, strongest first unless `is_reverse`, until it returns a value.
    fn for_nodes<T>(
        &self,
        prim: &StagePrim,
        is_reverse: bool,
        mut of: impl FnMut(&Rc<LayerFile<'a>>, usize, Retime) -> Result<Option<T>>,
    ) -> Result<Option<T>> {
        let mut all = Vec::new();
        for site in &prim.sites {
            let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
            all.extend(site.nodes.iter().map(|&(index, node)| {
                let (layer, retime) = stack.layers[index];
                (layer, node, combined(site.retime, retime))
            }));
        }
        if is_reverse {
            all.reverse();
        }
        for (layer, node, retime) in all {
            if let Some(found) = of(&self.file(layer), node, retime)? {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// The strongest value of a field of a prim.
    pub(crate) fn prim_field(&self, prim: &StagePrim, name: &str) -> Result<Option<Value>> {
        self.for_nodes(prim, false, |file, node, _| file.layer.field(node, name))
    }

    /// The type of a prim, such as `Points`; empty without one.
    pub(crate) fn type_name(&self, prim: &StagePrim) -> Result<String> {
        let found = self.for_nodes(prim, false, |file, node, _| {
            Ok(file.layer.word(node, "typeName")?.filter(|name| !name.is_empty()))
        })?;
        Ok(found.unwrap_or_default())
    }

    /// The names of the attributes of a prim.
    pub(crate) fn attribute_names(&self, prim: &StagePrim) -> Result<Vec<String>> {
        let mut names: Vec<String> = Vec::new();
        self.for_nodes(prim, false, |file, node, _| {
            let nodes = &file.layer.nodes;
            for LayerNode { name, .. } in
                nodes[node].order.iter().map(|child| &nodes[*child]).filter(|child| child.is_attribute)
            {
                self.limits.check_attributes(FORMAT, names.len(), "attributes of a prim")?;
                if !names.iter().any(|known| **known == **name) {
                    names.push(name.to_string());
                }
            }
            Ok(None::<()>)
        })?;
        Ok(names)
    }

    /// The strongest value of a field of an attribute.
    pub(crate) fn attribute_field(
        &self,
        prim: &StagePrim,
        attribute: &str,
        name: &str,
    ) -> Result<Option<Value>> {
        self.for_nodes(prim, false, |file, node, _| match file.layer.child(node, attribute) {
            Some(child) => file.layer.field(child, name),
            None => Ok(None),
        })
    }

    /// The strongest value of an attribute; `None` if it has none.
    pub(crate) fn attribute(&self, prim: &StagePrim, name: &str) -> Result<Option<StrongestValue<'a>>> {
        self.for_nodes(prim, false, |file, node, retime| {
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
            Ok(is_there.then(|| StrongestValue { file: Rc::clone(file), samples, default }))
        })
    }

    /// The site of the root of a stack.
    fn root(&self, stack: usize) -> Vec<Site> {
        let count = self.stacks.borrow()[stack].layers.len();
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
            Some((index, self.file(stack.layers[index].0).layer.child(node, name)?))
        };
        Site { nodes: site.nodes.iter().filter_map(child).collect(), ..*site }
    }

    /// Adds a site and what it brings in.
    fn expand(&self, site: Site, found: &mut Vec<Site>, path: &str, depth: usize) -> Result<()> {
        if site.nodes.is_empty() {
            return Ok(());
        }
        self.work.set(self.work.get() + 1);
        if depth > ARC_DEPTH_MAX || self.work.get() > SITES_MAX {
            let what = format!(
                "the references of {} are nested more than {ARC_DEPTH_MAX} deep or contain themselves, or the stage has \
                 too many prims",
                excerpt(path)
            );
            return Err(Error::too_large(FORMAT, what));
        }
        found.push(site.clone());
        for target in self.names(&site, "inheritPaths")? {
            let same_stack = LayerArc { asset: String::new(), prim: target, retime: [0.0, 1.0] };
            self.follow(&site, None, &same_stack, found, path, depth)?;
        }
        for set in self.names(&site, "variantSetNames")? {
            if let Some(variant) = self.selection(found, &set)? {
                self.expand(self.child_site(&site, &format!("{{{set}={variant}}}")), found, path, depth + 1)?;
            }
        }
        for field in ["references", "payload"] {
            for (layer, arc) in self.arcs(&site, field)? {
                self.follow(&site, Some(layer), &arc, found, path, depth)?;
            }
        }
        for target in self.names(&site, "specializes")? {
            let same_stack = LayerArc { asset: String::new(), prim: target, retime: [0.0, 1.0] };
            self.follow(&site, None, &same_stack, found, path, depth)?;
        }
        Ok(())
    }

    /// Adds the sites of the prim to which an arc of a layer leads.
    fn follow(
        &self,
        site: &Site,
        layer: Option<usize>,
        arc: &LayerArc,
        found: &mut Vec<Site>,
        path: &str,
        depth: usize,
    ) -> Result<()> {
        let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
        let mut retime = site.retime;
        let target = match layer {
            Some(index) if !arc.asset.is_empty() => {
                let (file, of_layer) = stack.layers[index];
                let further = self.further_file(file, &arc.asset, excerpt(path).as_str())?;
                let ratio = codes_per_second(&self.file(stack.layers[0].0).layer)?
                    / codes_per_second(&self.file(further).layer)?;
                let own = combined(of_layer, arc.retime);
                retime = combined(retime, [own[0], own[1] * ratio]);
                self.stack(further)?
            }
            Some(index) => {
                retime = combined(retime, combined(stack.layers[index].1, arc.retime));
                site.stack
            }
            None => site.stack,
        };
        let first = self.stacks.borrow()[target].layers[0].0;
        let prim = match arc.prim.as_str() {
            "" => self.file(first).layer.word(0, "defaultPrim")?.unwrap_or_default(),
            prim => prim.to_owned(),
        };
        let mut sites = self.root(target);
        for name in prim.split('/').filter(|name| !name.is_empty()) {
            sites = self.child(&sites, name, path, depth + 1)?;
        }
        if sites.is_empty() || prim.is_empty() {
            let what =
                format!("{} refers to the prim `{}`, which does not exist", excerpt(path), excerpt(&prim));
            return Err(Error::unsupported(FORMAT, what));
        }
        found.extend(sites.into_iter().map(|site| Site { retime: combined(retime, site.retime), ..site }));
        Ok(())
    }

    /// The list of names in a field, with the edits of all layers.
    fn names(&self, site: &Site, field: &str) -> Result<Vec<String>> {
        let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
        let mut names = Vec::new();
        for &(index, node) in site.nodes.iter().rev() {
            let layer = &self.file(stack.layers[index].0).layer;
            names = match layer.field(node, field)? {
                Some(Value::WordEdits(edits)) => edits.apply(names),
                Some(value) => layer.words(&value)?,
                None => names,
            };
        }
        Ok(names)
    }

    /// The references or payloads, each with the index of the layer that has it.
    fn arcs(&self, site: &Site, field: &str) -> Result<Vec<(usize, LayerArc)>> {
        let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
        let mut arcs = Vec::new();
        for &(index, node) in site.nodes.iter().rev() {
            if let Some(Value::ArcEdits(edits)) = self.file(stack.layers[index].0).layer.field(node, field)? {
                let edits: ListEdits<(usize, LayerArc)> = edits.map(|arc| Ok((index, arc.clone())))?;
                arcs = edits.apply(arcs);
            }
        }
        Ok(arcs)
    }

    /// The selected variant of a set.
    fn selection(&self, sites: &[Site], set: &str) -> Result<Option<String>> {
        for site in sites {
            let stack = Rc::clone(&self.stacks.borrow()[site.stack]);
            for &(index, node) in &site.nodes {
                let selected = self.file(stack.layers[index].0).layer.field(node, "variantSelection")?;
                if let Some(Value::Dictionary(entries)) = selected
                    && let Some((_, Value::Word(variant))) = entries.into_iter().find(|(name, _)| name == set)
                {
                    return Ok(Some(variant).filter(|variant| !variant.is_empty()));
                }
            }
        }
        Ok(None)
    }
}

/// The time codes of a second in a layer.
fn codes_per_second(layer: &Layer) -> Result<f64> {
    let stated = match layer.number(0, "timeCodesPerSecond")? {
        Some(stated) => Some(stated),
        None => layer.number(0, "framesPerSecond")?,
    };
    Ok(stated.filter(|stated| stated.is_finite() && *stated > 0.0).unwrap_or(24.0))
}

/// The path of a file that the file `from` names; `None` if it is outside the folder of the first one.
fn beside(from: &str, asset: &str) -> Option<String> {
    if asset.starts_with(['/', '\\']) || asset.contains([':', '\0', '[']) {
        return None;
    }
    let mut names: Vec<&str> = from.split('/').collect();
    names.pop();
    for name in asset.split(['/', '\\']) {
        match name {
            "" | "." => {}
            ".." => drop(names.pop()?),
            name => names.push(name),
        }
    }
    Some(names.join("/")).filter(|path| !path.is_empty())
}
