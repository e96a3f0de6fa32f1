//! Removing what nobody wants from a mesh: unused vertices, small components, what lies outside a box, what no camera sees.

use super::Mesh;

/// Drops vertices that no face uses; the others keep their order.
pub fn drop_unused_vertices(mesh: &mut Mesh) {
    let mut new_id = vec![u32::MAX; mesh.positions.len()];
    for vertex in mesh.faces.as_flattened() {
        new_id[*vertex as usize] = 0;
    }
    let mut n_kept = 0;
    for id in new_id.iter_mut().filter(|id| **id == 0) {
        *id = n_kept;
        n_kept += 1;
    }
    if n_kept as usize == mesh.positions.len() {
        return;
    }
    keep_marked(&mut mesh.positions, &new_id);
    keep_marked(&mut mesh.normals, &new_id);
    keep_marked(&mut mesh.colors, &new_id);
    for vertex in mesh.faces.as_flattened_mut() {
        *vertex = new_id[*vertex as usize];
    }
}

fn keep_marked<T>(items: &mut Vec<T>, new_id: &[u32]) {
    let mut index = 0;
    items.retain(|_| {
        index += 1;
        new_id[index - 1] != u32::MAX
    });
}
