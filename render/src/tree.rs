//! A tree of boxes, in which rays find the items that they may hit.

use glam::DVec3;
use meniscus_surface::space::joined;

use crate::surface::Ray;

/// Items in a tree of boxes.
#[derive(Default)]
pub(super) struct BoxTree {
    /// The root comes first.
    nodes: Vec<BoxNode>,
    /// The items, leaf by leaf.
    order: Vec<u32>,
}

/// A branch of the tree, or a leaf.
struct BoxNode {
    least: DVec3,
    greatest: DVec3,
    /// The first item of a leaf; the second child of a branch, whose first child is the next node.
    first: u32,
    /// Number of items; 0 for a branch.
    count: u32,
}

/// Maximum number of items in a leaf.
const LEAF_ITEMS: usize = 4;

impl BoxTree {
    /// The tree of these items, by the centers of their boxes.
    pub(super) fn new(mut items: Vec<(DVec3, u32)>, box_around: &impl Fn(u32) -> [DVec3; 2]) -> BoxTree {
        let mut tree = BoxTree { nodes: Vec::new(), order: Vec::with_capacity(items.len()) };
        if !items.is_empty() {
            tree.add_node(&mut items, box_around);
        }
        tree
    }

    /// The box around all items.
    pub(super) fn bounds(&self) -> Option<[DVec3; 2]> {
        self.nodes.first().map(|root| [root.least, root.greatest])
    }

    /// Adds the node of these items, and the nodes below it. Returns its index.
    fn add_node(&mut self, items: &mut [(DVec3, u32)], box_around: &impl Fn(u32) -> [DVec3; 2]) -> usize {
        let node = self.nodes.len();
        if items.len() <= LEAF_ITEMS {
            // Their order after the selection below depends on the library.
            items.sort_unstable_by_key(|&(_, index)| index);
            let boxes = items.iter().map(|&(_, index)| box_around(index));
            let [least, greatest] = boxes.reduce(joined).unwrap_or([DVec3::ZERO; 2]);
            let (first, count) = (self.order.len() as u32, items.len() as u32);
            self.nodes.push(BoxNode { least, greatest, first, count });
            self.order.extend(items.iter().map(|&(_, index)| index));
            return node;
        }
        let centers = items.iter().map(|&(center, _)| [center; 2]).reduce(joined);
        let axis = centers.map_or(0, |[least, greatest]| (greatest - least).max_position());
        let half = items.len() / 2;
        items.select_nth_unstable_by(half, |one, other| {
            one.0[axis].total_cmp(&other.0[axis]).then(one.1.cmp(&other.1))
        });
        let (one, other) = items.split_at_mut(half);
        self.nodes.push(BoxNode { least: DVec3::ZERO, greatest: DVec3::ZERO, first: 0, count: 0 });
        let children = [self.add_node(one, box_around), self.add_node(other, box_around)];
        let [one, other] = children.map(|child| [self.nodes[child].least, self.nodes[child].greatest]);
        let [least, greatest] = joined(one, other);
        self.nodes[node] = BoxNode { least, greatest, first: children[1] as u32, count: 0 };
        node
    }

    /// Calls `each` with the items that a ray may hit below a limit of t, which is the second argument, in any order.
    /// `each` returns the new limit.
    pub(super) fn visit(&self, ray: &Ray, mut each: impl FnMut(u32, f64) -> f64) {
        let mut limit = f64::INFINITY;
        let entry = |node: usize, limit: f64| {
            let BoxNode { least, greatest, .. } = self.nodes.get(node)?;
            ray.within(*least, *greatest, [0.0, limit]).map(|[first, _]| (first, node))
        };
        // At most one node for each level of the tree, which halves at most 2³² items.
        let mut pending = [(0.0, 0); 64];
        let mut count = 0;
        if let Some(root) = entry(0, limit) {
            (pending[0], count) = (root, 1);
        }
        while count > 0 {
            count -= 1;
            let (first, index) = pending[count];
            if first > limit {
                continue;
            }
            let node = &self.nodes[index];
            if node.count == 0 {
                let mut children = [index + 1, node.first as usize].map(|child| entry(child, limit));
                // The nearer child is visited first.
                if let [Some(one), Some(other)] = children
                    && one.0 < other.0
                {
                    children.swap(0, 1);
                }
                for child in children.into_iter().flatten() {
                    pending[count] = child;
                    count += 1;
                }
                continue;
            }
            for &item in &self.order[node.first as usize..][..node.count as usize] {
                limit = each(item, limit);
            }
        }
    }
}
