//! Removing what nobody wants from a mesh: unused vertices and small components.

use super::Mesh;

/// Keeps the faces for which `keep` is true, and the vertices that they use; order is kept.
pub fn keep_faces(mesh: &mut Mesh, mut keep: impl FnMut(usize) -> bool) {
    let mut face = 0;
    mesh.faces.retain(|_| {
        face += 1;
        keep(face - 1)
    });
    drop_unused_vertices(mesh);
}

/// Drops vertices that no face uses; the others keep their order.
pub fn drop_unused_vertices(mesh: &mut Mesh) {
    const UNUSED: u32 = u32::MAX;
    let mut new_id = vec![UNUSED; mesh.positions.len()];
    for vertex in mesh.faces.as_flattened() {
        new_id[*vertex as usize] = 0;
    }
    let mut n_kept = 0;
    for id in new_id.iter_mut().filter(|id| **id != UNUSED) {
        *id = n_kept;
        n_kept += 1;
    }
    if n_kept as usize == mesh.positions.len() {
        return;
    }
    fn retain<T>(items: &mut Vec<T>, new_id: &[u32]) {
        let mut ids = new_id.iter();
        items.retain(|_| *ids.next().expect("an id per vertex") != UNUSED);
    }
    retain(&mut mesh.positions, &new_id);
    retain(&mut mesh.normals, &new_id);
    retain(&mut mesh.colors, &new_id);
    for vertex in mesh.faces.as_flattened_mut() {
        *vertex = new_id[*vertex as usize];
    }
}

/// The connected component of every face, and the number of faces of every component. Faces are connected by common vertices.
pub fn components(mesh: &Mesh) -> (Vec<u32>, Vec<usize>) {
    // Union-find over vertices, with path halving.
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(parent: &mut [u32], mut vertex: u32) -> u32 {
        while parent[vertex as usize] != vertex {
            parent[vertex as usize] = parent[parent[vertex as usize] as usize];
            vertex = parent[vertex as usize];
        }
        vertex
    }
    for &[a, b, c] in &mesh.faces {
        for other in [b, c] {
            let (a, other) = (root(&mut parent, a), root(&mut parent, other));
            parent[a.max(other) as usize] = a.min(other);
        }
    }
    let mut component_of_root = vec![u32::MAX; mesh.positions.len()];
    let mut sizes = Vec::new();
    let component = mesh.faces.iter().map(|face| {
        let component = &mut component_of_root[root(&mut parent, face[0]) as usize];
        if *component == u32::MAX {
            *component = sizes.len() as u32;
            sizes.push(0);
        }
        sizes[*component as usize] += 1;
        *component
    });
    (component.collect(), sizes)
}

/// Keeps only the component with the most faces (the first of them, if several have as many).
pub fn keep_largest(mesh: &mut Mesh) {
    let (component, sizes) = components(mesh);
    let most = sizes.iter().max().copied().unwrap_or(0);
    let largest = sizes.iter().position(|&size| size == most);
    keep_faces(mesh, |face| Some(component[face] as usize) == largest);
}

/// Drops components with fewer than `min_faces` faces.
pub fn drop_small(mesh: &mut Mesh, min_faces: usize) {
    let (component, sizes) = components(mesh);
    keep_faces(mesh, |face| sizes[component[face] as usize] >= min_faces);
}
