//! Removes vertices without a triangle.

use rayon::prelude::*;

use super::Mesh;
use crate::parallel::Loops as _;

impl Mesh {
    /// Removes vertices that no triangle uses. The others keep their order.
    pub(super) fn drop_unused_vertices(&mut self) {
        let mut is_used = vec![false; self.positions.len()];
        self.triangles.iter().flatten().for_each(|&vertex| is_used[vertex as usize] = true);
        let mut next = 0;
        let numbers: Vec<u32> = is_used
            .iter()
            .map(|&is_used| {
                let number = next;
                next += u32::from(is_used);
                number
            })
            .collect();
        self.triangles
            .par_iter_mut()
            .halved()
            .flatten()
            .for_each(|vertex| *vertex = numbers[*vertex as usize]);
        for column in [&mut self.positions, &mut self.normals] {
            let mut uses = is_used.iter();
            column.retain(|_| uses.next().is_some_and(|&is_used| is_used));
            column.shrink_to_fit();
        }
    }
}
